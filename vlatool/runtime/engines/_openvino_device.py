"""What OpenVINO's devices beside the processor share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from vlatool.errors import GraphError, MissingExtra, fix_for, require, suggest
from vlatool.machine.host import ROOT, intel_devices, read_text, versions
from vlatool.runtime import arithmetic
from vlatool.runtime.engine import Int8Layout, Stages
from vlatool.runtime.engines._openvino_core import openvino_core
from vlatool.runtime.engines.openvino import OpenvinoSession

if TYPE_CHECKING:
    from vlatool.machine.target import Target


class OpenvinoDevice(OpenvinoSession):
    """One ONNX file compiled by OpenVINO for a device beside the processor; never for the processor in its place."""

    kernel_name: ClassVar[str] = ""
    """Where the kernel lists the device (``host.intel_devices``)."""
    driver: ClassVar[str] = ""
    """What installs the driver."""
    confined = False
    searched = False
    layouts: ClassVar[Mapping[str, Int8Layout]] = {}

    @classmethod
    def is_installed(cls) -> bool:
        """Return whether OpenVINO is installed and the kernel drives such a device, without importing anything."""
        return super().is_installed() and bool(intel_devices(cls.kernel_name))

    @classmethod
    def execution_providers(cls) -> list[str]:
        """Return the devices of this kind that OpenVINO finds; raises MissingExtra when there is none."""
        core = openvino_core()
        cls._check_device(core)
        return [name for name in core.available_devices if name.partition(".")[0] == cls.device]

    @classmethod
    def identity(cls) -> str:
        """Return the device, OpenVINO's release, and that of the kernel, which has the driver."""
        found = ", ".join(intel_devices(cls.kernel_name))
        kernel = read_text(ROOT, "proc/sys/kernel/osrelease") or ""
        return f"{cls.device} {found}; openvino {versions(('openvino',)).get('openvino', '')}; Linux {kernel}"

    @classmethod
    def hardware(cls) -> tuple[str, str]:
        """Return the device's name, as OpenVINO gives it, and the kernel's release."""
        kernel = read_text(ROOT, "proc/sys/kernel/osrelease") or ""
        return str(openvino_core().get_property(cls.device, "FULL_DEVICE_NAME")), f"Linux {kernel}"

    @staticmethod
    def arithmetic() -> str:
        """Return that integer products are not measured; raises MissingExtra when openvino is not installed."""
        require("openvino", "openvino")
        return arithmetic.UNKNOWN

    @classmethod
    def variants(cls, target: Target, calibrated: bool) -> dict[str, Stages]:
        """Return no plans: none was tried on such a device."""
        return {}

    @classmethod
    def settings(cls, threads: int | None, compute: str) -> dict[str, Any]:
        """Return what a model is compiled with; raises GraphError when the device does not compute in that dtype."""
        if compute not in cls.hints:
            known = [name for name in cls.hints if name]
            raise GraphError(
                f"OpenVINO on the {cls.device} does not compute in {compute}; {suggest(compute, known)}.",
                fix_for(compute, known),
            )
        return {"INFERENCE_PRECISION_HINT": cls.hints[compute], "PERFORMANCE_HINT": "LATENCY"}

    @classmethod
    def _compile(cls, core: Any, model: Any, settings: dict[str, Any]) -> Any:
        return core.compile_model(model, cls.device, settings)

    @classmethod
    def _check_device(cls, core: Any) -> None:
        found = [str(name) for name in core.available_devices]
        if cls.device not in [name.partition(".")[0] for name in found]:
            raise MissingExtra(
                f"OpenVINO finds no {cls.device} on this machine; it finds {', '.join(found) or 'nothing'}.", cls.driver
            )
