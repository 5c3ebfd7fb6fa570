"""`python -m sim_link`."""

import sys

from sim_link.cli import main

sys.exit(main())
