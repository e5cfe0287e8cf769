"""`python -m corrmat` is the console script `corrmat`."""

import sys

from corrmat.cli import main

sys.exit(main())
