"""`python -m companion.cli`: the same as `mavfdi`."""

import sys

from companion.cli import main

sys.exit(main())
