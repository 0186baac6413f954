"""`python -m experiments.cli` is the command `estima`."""

from experiments.cli.main import main

main()
