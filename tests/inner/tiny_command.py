"""The command line with a configuration of hardly any iterations: ``python tiny_command.py run spring.py …``."""

import small_runs

from ccdtools.cli import main
from ccdtools.studies import preparation

if __name__ == "__main__":
    preparation.configuration = small_runs.tiny_configuration  # type: ignore[assignment]
    main()
