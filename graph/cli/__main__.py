"""`python -m mapstream.graph.cli` is `mapstream`."""

from mapstream.graph.cli import main

main()
