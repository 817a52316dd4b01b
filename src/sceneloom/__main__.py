"""`python -m sceneloom`: the command line."""

from sceneloom.cli import main

main()
