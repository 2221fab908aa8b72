"""YAML files that people write, read with errors that say which file and what is wrong with it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from vlatool.errors import InputError, require


def read_yaml(path: Path, what: str, raised: type[InputError]) -> Any:
    """Return what a YAML file holds.

    Args:
        path: The file.
        what: What it is, as the subject of a sentence: ``The recipe out/recipe.yaml``.
        raised: Class of the errors.

    Raises:
        InputError: of the class ``raised``, when the file is missing, cannot be read, or is no YAML.
    """
    yaml = require("yaml", "build")
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise raised(f"{what} cannot be read: {error.strerror or error}.") from error
    except UnicodeDecodeError as error:
        raise raised(f"{what} is not valid YAML: it cannot be read as UTF-8: {error}.") from error
    except (yaml.YAMLError, ValueError) as error:  # a date that is none (2024-02-30) is a ValueError
        raise raised(f"{what} is not valid YAML: {' '.join(str(error).split())}.") from error


def read_mapping(path: Path, what: str, raised: type[InputError]) -> dict[str, Any]:
    """Return the mapping of a YAML file.

    Args:
        path: The file.
        what: What it is, as the subject of a sentence.
        raised: Class of the errors.

    Raises:
        InputError: of the class ``raised``, when ``read_yaml`` raises, or the file holds something else.
    """
    data = read_yaml(path, what, raised)
    if not isinstance(data, dict):
        raise raised(f"{what} must be a mapping; got {type(data).__name__}.")
    return data
