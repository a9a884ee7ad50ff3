"""Exit codes of all our programs."""

from __future__ import annotations

import signal

EXIT_OK = 0
"""Done; of a command that answers a question: yes."""
EXIT_FAILED = 1
"""Not done; another try may succeed."""
EXIT_NO = 1
"""Of a command that answers a question: no."""
EXIT_USAGE = 2
"""The command line, the configuration or the installation is wrong; another try ends the same way."""
EXIT_NO_READER = 128 + signal.SIGPIPE
"""The exit code that the shell reports for a program ended by SIGPIPE, ..."""
EXIT_INTERRUPTED = 128 + signal.SIGINT
"""... or by Ctrl-C."""
