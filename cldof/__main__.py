"""``python -m cldof``: the command line, where its script is not on the PATH."""

import sys

from .cli import main

__all__: list[str] = []

sys.exit(main())
