"""`python -m fusecap`."""

from fusecap.cli import main

main()
