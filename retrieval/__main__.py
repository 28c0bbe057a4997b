"""`python -m retrieval`: the command line, where no script `retrieve` is installed."""

import sys

from retrieval.commands.main import main

sys.exit(main())
