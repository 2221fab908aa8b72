from vlatool.hardware.profile import load_profile
from vlatool.machine import host, target
from vlatool.machine.target import target_of


def test_a_board_brings_its_profile_its_devices_and_the_features_of_its_processor() -> None:
    jetson = load_profile("jetson-orin-nano")
    found = target_of(jetson)
    assert found.profile is jetson
    assert found.devices == (jetson.units["gpu"].title,)
    assert found.has("avx2", "asimd")
    assert not found.has("avx2")
    assert not found.has()


def test_without_a_board_it_is_this_host(monkeypatch) -> None:
    monkeypatch.setattr(target, "gpus", lambda: ("NVIDIA A10",))
    found = target_of(None)
    assert (found.profile, found.devices) == (None, ("NVIDIA A10",))
    assert found.features == frozenset(host.isa() or ())
