"""Small tensors of a safetensors file as numpy arrays, without the library of that name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import SourceError
from vlatool.files.limits import check_limit
from vlatool.weights.shards import NUMPY_NAMES, read_header

DTYPES = {stored: name for name, stored in NUMPY_NAMES.items() if name != "bfloat16"}


def read_tensors(file: Path) -> dict[str, NDArray[Any]]:
    """Return name -> array.

    Raises:
        SourceError: when it is missing, damaged, larger than ``statistics_bytes``, or of a dtype that numpy lacks.
    """
    if not file.is_file():
        raise SourceError(f"No such file: {file}.", "copy the whole directory again")
    check_limit("statistics_bytes", file.stat().st_size, str(file), SourceError)
    values = {}
    with file.open("rb") as stream:
        for tensor in read_header(file):
            if tensor.dtype not in DTYPES:
                raise SourceError(f"{file} holds '{tensor.name}' as {tensor.dtype}.", "store it as float32")
            stream.seek(tensor.offset)
            content = np.frombuffer(stream.read(tensor.nbytes), DTYPES[tensor.dtype])
            values[tensor.name] = content.reshape(tensor.shape)
    return values
