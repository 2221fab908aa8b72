"""A source: the directory that a trainer of Acme's leaves, with an acme.json, code and weights."""

import json
from pathlib import Path

from vlatool.bundle.spec import PolicySpec
from vlatool.module.description import Description
from vlatool.registry import Claim
from vlatool.sources.torch_module import TorchModule


class AcmeCheckpoint(TorchModule):
    """A policy that an acme.json describes."""

    needs = "a directory with an acme.json"

    @classmethod
    def claims(cls, typed):
        """Claim a directory with an acme.json."""
        return Claim.CERTAIN if Path(typed, "acme.json").is_file() else Claim.NONE

    def describe(self):
        """Read acme.json."""
        file = self.policy / "acme.json"
        acme = json.loads(file.read_text())
        return Description(
            folder=self.policy,
            name=acme["model"],
            version=acme["revision"],
            spec=PolicySpec.from_dict(acme["tensors"]),
            factory=acme["code"],
            environment=acme["simulation"],
            calibration=self.policy / acme["log"],
            read_from=(file,),
        )
