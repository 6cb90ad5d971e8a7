"""``python -m dgorl``."""

import sys

from dgorl.cli.main import main

sys.exit(main())
