"""report.json and report.html: the schema of a run's results, and the page that shows them."""

from nebula.report.page import html_page
from nebula.report.schema import SCHEMA_VERSION, stable_part, validate_report

__all__ = ["SCHEMA_VERSION", "html_page", "stable_part", "validate_report"]
