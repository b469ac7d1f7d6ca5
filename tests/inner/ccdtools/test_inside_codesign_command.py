"""What test_codesign_command.py claims, seen from inside."""

import signal

import pytest

from ccdtools.studies.report.method_page import write_table
from ccdtools.studies.run_folder import RunFolder


def test_a_table_that_is_interrupted_while_it_is_written_is_whole(tmp_path):
    class Interrupted:
        def to_csv(self, path):
            with path.open("w") as file:
                file.write("begun, ")
                signal.raise_signal(signal.SIGINT)
                file.write("ended")

    with pytest.raises(KeyboardInterrupt):
        write_table(Interrupted(), RunFolder(tmp_path / "kept"))
    assert (tmp_path / "kept" / "methods.csv").read_text() == "begun, ended"
