"""``python -m nebula``."""

from nebula.cli import main

main()
