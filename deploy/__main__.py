"""`python -m deploy` runs `shoal`."""

import sys

from deploy.cli import main

sys.exit(main())
