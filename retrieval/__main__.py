"""`python -m retrieval`: the command line, if the script `retrieve` is not installed."""

import sys

from retrieval.commands.main import main

sys.exit(main())
