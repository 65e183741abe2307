"""`python -m ringfence` is `ringfence`."""

import sys

from ringfence.cli.app import main

sys.exit(main())
