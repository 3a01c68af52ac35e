"""`python -m deploy` is `shoal`."""

import sys

from deploy.cli import main

sys.exit(main())
