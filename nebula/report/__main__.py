"""``python -m nebula.report`` prints the table of docs/report.md."""

from nebula.report.schema import table

print(table(), end="")
