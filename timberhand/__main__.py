"""``python -m timberhand``."""

from timberhand.cli import main

main()
