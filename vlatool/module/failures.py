"""Why torch could not export or run a module: its own line, the operator, the line of the source, and the remedy."""

from __future__ import annotations

import linecache
import os
import re
import sysconfig
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

from vlatool.errors import GraphError
from vlatool.files.printable import message_of, one_line

GUIDE = "docs/guides/your-own-policy.md"
TOOLS = ("torch", "onnxscript", "onnx_ir", "onnx", "functorch")
"""Packages that export; a line of theirs is not where a policy goes wrong."""
MAX_CHARACTERS = 300
MAX_SEARCHED_CHARACTERS = 1 << 20
"""Characters of an error's text in which a cause is looked for."""


@dataclass(frozen=True)
class Cause:
    """A reason for which torch gives up.

    Args:
        pattern: found in ``TypeName: message`` of one of the chained errors, across its lines; None: not by its text.
    """

    name: str
    pattern: str | None
    remedy: str


GENERATE = Cause(
    "generate() inside forward()", None,
    "export one decoding step as a graph and let the program of policy.yaml run it: 'repeat' for a fixed number of "
    "tokens, 'keep' or 'carry' for the cache; generate() itself decides from its own output when it ends",
)  # fmt: skip
TORCHSCRIPT = Cause(
    "a TorchScript module", None,
    "build the Python module that was scripted and load its weights, or save it with torch.export.save: TorchScript "
    "cannot be exported again",
)  # fmt: skip
QUANTIZED_WEIGHTS = Cause(
    "weights that torch has quantized", r"\bquantized::|quantized\.\w*PackedParams|torch\.(?:qint8|quint8|qint32)\b",
    "let make() return the module as it was before torch quantized it, in float; vlatool quantize makes int8 of what "
    "is exported",
)  # fmt: skip
CHECKED_DISTRIBUTION = Cause(
    "a distribution that checks its parameters", None,
    "return what the distribution is made of (its mean, its logits), or turn the checks off in policy.py: "
    "torch.distributions.Distribution.set_default_validate_args(False)",
)  # fmt: skip
CONTROL_FLOW = Cause(
    "data-dependent control flow",
    r"data-dependent|DataDependent|Dynamic control flow|_local_scalar_dense|Tensor-likes? to a (?:bool|number)",
    "decide with torch.where() instead of 'if', a fixed number of turns instead of 'while'; keep int(), "
    "float() and .item() of tensors out of forward()",
)  # fmt: skip
OTHER_CAUSE = Cause("", "", f"change what that line names; {GUIDE} says what forward() may hold")
CAUSES = (
    QUANTIZED_WEIGHTS,
    Cause(
        "a generator of random numbers", r"Optional\[Generator\]|torch\._C\.Generator",
        "let forward() take the noise as an input, and declare it in the program: "
        "noise: {NAME: {shape: [...], distribution: normal}}",
    ),
    Cause(
        "a shape that depends on values",
        r"Size-like symbols: (?!none)|DynamicOutputShapeException|Unbacked ?[Ss]ym[Nn]ode",
        "keep tensors in their full shape and multiply by a mask, instead of x[mask], nonzero() or unique()",
    ),
    CONTROL_FLOW,
    Cause(
        "an operator of a package of its own", r"No ONNX function found for <OpOverload\(op='(?!aten\.|prims?\.)",
        "write it with torch's own operators, or use the package's fallback in plain torch: no engine has it",
    ),
    Cause(
        "an operator that ONNX lacks", r"No ONNX function found|UnsupportedOperator|No decompositions? registered",
        "write it with other operators (a matrix product, a sum of squares), or compute it in make() where it does not "
        "depend on the observation",
    ),
    Cause(
        "arguments that the exporter does not translate",
        r"is not supported in this export path|Error when calling function",
        "call the operator with explicit arguments, or write it with simpler operators",
    ),
    Cause(
        "an output that is not a tensor", r"translating node return",
        "return a tensor, or a tuple of tensors in the order of 'gives'",
    ),
    Cause(
        "tensors on different devices",
        r"same device|at least two devices|DeviceMismatch|expected device|Invalid device",
        "make new tensors with device=x.device or as buffers, and let make() return the module on the processor: "
        "module.to('cpu')",
    ),
    Cause(
        "tensors of different dtypes",
        r"same dtype|expected scalar type|expected m1 and m2|dtype mismatch|Input type .* and (?:bias|weight) type",
        "cast in forward() (x.float()), let make() return module.float(), or correct the dtype in the spec",
    ),
    Cause(
        "complex numbers", r"[Cc]omplex(?:Float|Double|64|128| )",
        "keep real and imaginary parts as two tensors: ONNX has no complex numbers",
    ),
    Cause(
        "a tensor turned into numpy", r"numpy\(\) (?:on|is not)|convert .*FakeTensor.* numpy|__array__",
        "stay in torch inside forward(), and compute constants in make()",
    ),
    Cause(
        "tensors of shapes that do not fit",
        r"shapes? .*(?:cannot be multiplied|is invalid for|mismatch)|must match the size of tensor|Expected \d+D",
        "correct the shapes in the spec, or reshape in forward(); the first axis is the batch of 1",
    ),
    Cause(
        "an input that changes in place", r"mutat|modified in-?place|in-place operation|requires grad.*in-place",
        "work on a copy: x = x.clone(); return what changed, or declare it with 'keep' in the program",
    ),
    Cause(
        "dynamic shapes", r"[Cc]onstraint|dynamic_shapes|dynamic dimension",
        "give every axis a number in policy.yaml, and take shapes from the spec, not from the data",
    ),
)  # fmt: skip
"""The table: the first cause whose pattern matches is reported."""


def export_error(error: BaseException, graph: str, module: Any) -> GraphError:
    """Return the error for an export in which ``torch.onnx.export`` raised ``error``."""
    chain = list(_chain(error))
    cause = _cause(chain, module)
    parts = [f"torch cannot export the graph '{graph}'"]
    parts += [cause.name] if cause.name else []
    node = _node(chain)
    operator = _operator(chain, node)
    where = _of_node(node) if node is not None else _of_frames(chain)
    parts.append(_line(chain))
    lines = [f"operator {operator}"] if operator and operator not in parts[-1] else []
    lines += [where] if where else []
    return GraphError(f"{': '.join(parts)}{' (' + '; '.join(lines) + ')' if lines else ''}.", cause.remedy)


def remedy_for(error: BaseException) -> str:
    """Return the remedy for what a module raised when it ran; empty when its own text must do."""
    cause = _cause_in_text(list(_chain(error)))
    return cause.remedy if cause else ""


def _chain(error: BaseException) -> Iterator[BaseException]:
    """The error and its causes, the root last."""
    seen: set[int] = set()
    current: BaseException | None = error
    while current is not None and id(current) not in seen:
        seen.add(id(current))
        yield current
        current = current.__cause__


def _cause(chain: list[BaseException], module: Any) -> Cause:
    if any(frame.f_code.co_name == "generate" for frame, _line in _frames(chain[-1]) if not _is_tool(frame)):
        return GENERATE
    if any(type(part).__module__.startswith("torch.jit") for part in getattr(module, "modules", list)()):
        return TORCHSCRIPT
    cause = _cause_in_text(chain) or OTHER_CAUSE
    return CHECKED_DISTRIBUTION if cause is CONTROL_FLOW and _in_distribution(chain) else cause


def _in_distribution(chain: list[BaseException]) -> bool:
    names = (str(frame.f_globals.get("__name__", "")) for frame, _line in _frames(chain[-1]))
    return any(name.startswith("torch.distributions.") for name in names)


def _cause_in_text(chain: list[BaseException]) -> Cause | None:
    """Return the first cause of the table that the text of an error names."""
    texts = [f"{type(error).__name__}: {message_of(error, MAX_SEARCHED_CHARACTERS)}" for error in reversed(chain)]
    for cause in CAUSES:
        if any(re.search(cause.pattern or "", text, re.DOTALL) for text in texts):
            return cause
    return None


def _line(chain: list[BaseException]) -> str:
    """The first line of torch's own message at the root."""
    root = chain[-1]
    lines = [line.strip() for line in message_of(root).splitlines() if line.strip()]
    text = one_line(lines[0] if lines else "", MAX_CHARACTERS).rstrip(".")
    return f"{type(root).__name__}: {text}" if text else type(root).__name__


def _operator(chain: list[BaseException], node: Any) -> str:
    match = re.search(r"OpOverload\(op='([\w.]+)'", message_of(chain[-1], MAX_SEARCHED_CHARACTERS))
    if match:
        return match[1]
    return str(node.target) if node is not None and node.op == "call_function" else ""


def _node(chain: list[BaseException]) -> Any:
    """Return the node of torch's graph that was translated when the error came; None when there was none."""
    for error in chain:
        for frame, _line in _frames(error):
            node = frame.f_locals.get("node")
            if _is_tool(frame) and hasattr(node, "meta") and hasattr(node, "op"):
                return node
    return None


def _of_node(node: Any) -> str:
    """Return module and line that a node of torch's graph was traced from."""
    parts = []
    stack = list((node.meta.get("nn_module_stack") or {}).values())
    if stack and stack[-1][0]:
        kind = stack[-1][1]
        parts.append(f"module {stack[-1][0]} ({getattr(kind, '__name__', str(kind).rpartition('.')[2])})")
    lines = re.findall(r'File "([^"]+)", line (\d+), in (\w+)', str(node.meta.get("stack_trace") or ""))
    own = [line for line in lines if not set(TOOLS) & set(Path(line[0]).parts)]
    if own:
        file, number, function = own[-1]
        parts.append(_describe_line(file, int(number), function))
    return ", ".join(parts)


def _of_frames(chain: list[BaseException]) -> str:
    """Return the innermost line of a policy's code, or of a library that it calls, and the module that ran."""
    frames = [(frame, line) for frame, line in _frames(chain[-1]) if not _is_tool(frame)]
    if not frames:
        return ""
    frame, line = frames[-1]
    owner = frame.f_locals.get("self")
    module = [f"module {type(owner).__name__}"] if hasattr(owner, "named_modules") else []
    return ", ".join([*module, _describe_line(frame.f_code.co_filename, line, frame.f_code.co_name)])


def _describe_line(file: str, number: int, function: str) -> str:
    parts = Path(file).parts
    packages = [index for index, part in enumerate(parts) if part in ("site-packages", "dist-packages")]
    name = "/".join(parts[packages[-1] + 1 :]) if packages else Path(file).name
    code = one_line(linecache.getline(file, number).strip(), 100)
    return one_line(f"{name}:{number} in {function}()", 200) + (f": {code}" if code else "")


def _frames(error: BaseException) -> Iterator[tuple[FrameType, int]]:
    trace: TracebackType | None = error.__traceback__
    while trace is not None:
        yield trace.tb_frame, trace.tb_lineno
        trace = trace.tb_next


def _is_tool(frame: FrameType) -> bool:
    """Return whether a frame is of torch, its exporter, vlatool or Python itself."""
    package = str(frame.f_globals.get("__name__", "")).partition(".")[0]
    file = os.path.realpath(frame.f_code.co_filename)
    own = (str(Path(__file__).parents[1]), os.path.realpath(sysconfig.get_path("stdlib")))
    library = file.startswith(own) and "site-packages" not in file
    return package in TOOLS or library or not os.path.isfile(file)
