"""`python -m companion.web`: started by the companion, not by people."""

from companion.web.server import main

main()
