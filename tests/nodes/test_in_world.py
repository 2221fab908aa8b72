"""Controllers in a simulated world: one chain, one clock, the same bytes for the same seed."""

from __future__ import annotations

import pytest
from _point_robot import GoTo, Limiter, PointWorld

from vlatool.messages import Message, cdr
from vlatool.messages.std_msgs import Bool
from vlatool.nodes.in_world import WorldRun, WorldStep, place


def heard(seed: int) -> list[tuple[str, bytes]]:
    found: list[tuple[str, bytes]] = []

    def hear(topic: str, message: Message) -> None:
        found.append((topic, bytes(cdr.encode(message))))

    WorldRun(PointWorld(), [place(GoTo())], seed=seed, heard=hear).run(2.0)
    return found


def test_a_controller_drives_the_robot_to_its_goal() -> None:
    world = PointWorld()
    count = WorldRun(world, [place(GoTo(goal=0.7))]).run(6.0)
    assert world.truth()["x"] == pytest.approx(0.7, abs=0.01)
    assert count == 6 * 20


def test_the_same_seed_gives_the_same_bytes() -> None:
    assert heard(3) == heard(3) != heard(4)


def test_what_one_writes_another_reads_in_the_same_moment() -> None:
    world = PointWorld()
    fastest = 0.0

    def watch(steps: list[WorldStep]) -> bool:
        nonlocal fastest
        fastest = max(fastest, abs(world.truth()["v"]))
        return False

    chain = [place(GoTo(), {"velocity": "/cmd_vel_wanted"}), place(Limiter())]
    WorldRun(world, chain).run(8.0, until=watch)
    assert fastest == 0.2
    assert world.truth()["x"] == pytest.approx(1.0, abs=0.01)


def test_an_end_is_seen_after_the_step() -> None:
    run = WorldRun(PointWorld(), [place(GoTo())])
    run.run(10.0, until=lambda steps: steps[0].snapshot.time_s >= 1.0)
    assert run.time_s == pytest.approx(1.0)


def test_a_service_is_called_by_its_name_on_the_bus() -> None:
    run = WorldRun(PointWorld(), [place(GoTo(), {"hold": "/arm/hold"})])
    assert run.ask("/hold", Bool()) is None
    number = run.ask("/arm/hold", Bool())
    assert number is not None
    assert list(run.step()[0].command.responses) == [number]
