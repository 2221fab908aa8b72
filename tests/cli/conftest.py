"""What the tests of the command line share."""

from __future__ import annotations

from typing import Any

import pytest

from vlatool.cli import main


@pytest.fixture
def vlatool(capsys):
    """Run a command line in this process; return status, stdout and stderr."""

    def run(*line: Any) -> tuple[int, str, str]:
        capsys.readouterr()
        with pytest.raises(SystemExit) as left:
            main([str(part) for part in line])
        told = capsys.readouterr()
        return left.value.code or 0, told.out, told.err

    return run
