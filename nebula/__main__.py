"""``python -m nebula``."""

from nebula.program import main

main()
