"""`python -m sim_link.lab.conformance`."""

from __future__ import annotations

import sys

from sim_link.lab.conformance.cli import main

sys.exit(main())
