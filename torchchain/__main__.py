"""``python -m torchchain``: the torchchain command."""

import sys

from torchchain.cli import main

sys.exit(main())
