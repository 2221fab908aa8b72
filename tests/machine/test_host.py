from __future__ import annotations

import json
import os
import platform
import socket
from pathlib import Path
from typing import Any

import pytest

from vlatool.machine import host

X86 = "processor : 0\nmodel name\t: Intel(R)  Core(TM) i7-1360P\nflags\t\t: fpu lm avx2 fma avx_vnni{extra}\n\n"
PI = "processor\t: {n}\nFeatures\t: fp asimd asimdhp asimddp\nCPU implementer\t: 0x41\nCPU part\t: {part}\n\n"
MEMORY = "MemTotal:       8000000 kB\nMemFree: 1 kB\nMemAvailable:   4000000 kB\n"


def tree(root: Path, files: dict[str, Any]) -> Path:
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(str(text))
    return root


def test_an_empty_tree_has_nothing_and_no_zeros(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.delenv("ONEDNN_MAX_CPU_ISA", raising=False)
    found = host.fingerprint(tmp_path)
    unknown = {key: value for key, value in found.items() if key not in ("python", "versions")}
    assert {*unknown.values()} == {None}


@pytest.mark.parametrize(
    ("said", "told"),
    [
        (None, None),
        ("", None),
        ("AVX2", "AVX2"),
        ("avx2", "AVX2"),
        ("default", None),
        ("ALL", None),
        ("/home/me", "?"),
        ("A" * 99, "?"),
    ],
)
def test_what_openvino_is_confined_to_is_recorded(monkeypatch, tmp_path: Path, said, told) -> None:
    monkeypatch.delenv("ONEDNN_MAX_CPU_ISA", raising=False)
    if said is not None:
        monkeypatch.setenv("ONEDNN_MAX_CPU_ISA", said)
    assert host.fingerprint(tmp_path)["onednn_max_cpu_isa"] == told


def test_the_older_name_of_the_variable_confines_where_the_newer_is_not_set():
    assert host.onednn_max_cpu_isa({"DNNL_MAX_CPU_ISA": "AVX2"}) == "AVX2"
    assert host.onednn_max_cpu_isa({"DNNL_MAX_CPU_ISA": "AVX2", "ONEDNN_MAX_CPU_ISA": "AVX512_CORE"}) == "AVX512_CORE"


def test_this_machine_is_described_in_json_without_names() -> None:
    found = host.fingerprint()
    text = json.dumps(found)
    assert found["architecture"] == platform.machine()
    assert found["cores"] == len(os.sched_getaffinity(0))
    assert found["memory_mb"] > found["memory_available_mb"] > 0
    assert found["python"] == platform.python_version()
    assert {"vlatool", "numpy"} <= {*found["versions"]}
    assert str(Path.home()) not in text
    assert len(socket.gethostname()) < 4 or f'"{socket.gethostname()}"' not in text


def test_an_x86_board(tmp_path: Path) -> None:
    policy = "sys/devices/system/cpu/cpufreq/policy"
    root = tree(
        tmp_path,
        {
            "proc/cpuinfo": X86.format(extra=" avx512_vnni") + X86.format(extra=" hypervisor"),
            "proc/meminfo": MEMORY,
            "proc/loadavg": "0.50 1.25 2.00 1/100 4242\n",
            "proc/sys/kernel/osrelease": "6.8.0-45-generic\n",
            "proc/self/status": "Name:\tpython\nCpus_allowed_list:\t0-3,6\n",
            "sys/devices/system/cpu/online": "0-15\n",
            "sys/class/dmi/id/sys_vendor": "Intel(R) Client Systems\n",
            "sys/class/dmi/id/product_name": "NUC13ANHi7\n",
            f"{policy}0/scaling_governor": "powersave\n",
            f"{policy}0/scaling_min_freq": "400000\n",
            f"{policy}0/scaling_max_freq": "5000000\n",
            f"{policy}8/scaling_governor": "performance\n",
            f"{policy}8/scaling_max_freq": "3700000\n",
            "sys/devices/system/cpu/intel_pstate/no_turbo": "0\n",
            "etc/os-release": 'NAME="Ubuntu"\nPRETTY_NAME="Ubuntu 24.04.1 LTS"\n',
        },
    )
    found = host.fingerprint(root)
    assert found["cpu"] == "Intel(R) Core(TM) i7-1360P"
    assert found["architecture"] == "x86_64"
    assert found["board"] == "Intel(R) Client Systems NUC13ANHi7"
    assert found["isa"] == ["avx2", "fma", "avx_vnni"], "only what every core has"
    assert (found["cores"], found["cores_online"], found["cpu_quota"]) == (5, 16, None)
    assert (found["memory_mb"], found["memory_available_mb"], found["memory_limit_mb"]) == (8192.0, 4096.0, None)
    assert found["governor"] == "powersave, performance"
    assert (found["clock_min_mhz"], found["clock_max_mhz"], found["clock_now_mhz"]) == ([400], [5000, 3700], None)
    assert found["turbo"] is True
    assert found["load_average"] == [0.5, 1.25, 2.0]
    assert (found["kernel"], found["os"]) == ("6.8.0-45-generic", "Ubuntu 24.04.1 LTS")
    assert found["virtual_machine"] is not None
    assert host.matches(["i7-1360p"], found)
    assert host.matches(["NUC13ANH"], found)
    assert not host.matches(["Raspberry Pi 5"], found)


def test_an_arm_board(tmp_path: Path) -> None:
    parts = ["0xd0b", "0xd0b", "0xd0b", "0x999"]
    root = tree(
        tmp_path,
        {
            "proc/cpuinfo": "".join(PI.format(n=n, part=part) for n, part in enumerate(parts)),
            "proc/device-tree/model": "Raspberry Pi 5 Model B Rev 1.0\0",
            "sys/devices/system/cpu/cpufreq/boost": "0",
            "etc/nv_tegra_release": "# R36 (release), REVISION: 4.7, GCID: 1",
        },
    )
    found = host.fingerprint(root)
    assert found["cpu"] == "3x Cortex-A76 + 1x ARM 0x41/0x999"
    assert found["architecture"] == "aarch64"
    assert found["board"] == "Raspberry Pi 5 Model B Rev 1.0"
    assert found["isa"] == ["asimd", "asimdhp", "asimddp"]
    assert found["turbo"] is False
    assert found["os"] == "L4T 36.4.7"
    assert found["virtual_machine"] is None
    assert host.matches(["Raspberry Pi 5"], found)
    assert not host.matches([], found)


def test_limits_of_cgroup_v2_are_taken_from_every_level(tmp_path: Path) -> None:
    root = tree(
        tmp_path,
        {
            "proc/self/cgroup": "0::/slice/job\n",
            "sys/fs/cgroup/slice/job/cpu.max": "max 100000\n",
            "sys/fs/cgroup/slice/cpu.max": "150000 100000\n",
            "sys/fs/cgroup/slice/job/memory.max": "2000000000\n",
            "sys/fs/cgroup/slice/memory.max": "max\n",
            "run/.containerenv": "",
        },
    )
    assert host.cpu_quota(root) == 1.5
    assert host.memory(root)["memory_limit_mb"] == 2000
    assert host.container(root) == "podman"


def test_limits_of_cgroup_v1(tmp_path: Path) -> None:
    root = tree(
        tmp_path,
        {
            "proc/self/cgroup": "4:memory:/docker/abc\n3:cpu,cpuacct:/docker/abc\n9:name=systemd:/\nodd\n",
            "proc/1/cgroup": "4:memory:/docker/abc\n",
            "sys/fs/cgroup/cpu/cpu.cfs_quota_us": "-1",
            "sys/fs/cgroup/cpu,cpuacct/docker/abc/cpu.cfs_quota_us": "50000",
            "sys/fs/cgroup/cpu,cpuacct/docker/abc/cpu.cfs_period_us": "100000",
            "sys/fs/cgroup/memory/memory.limit_in_bytes": "9223372036854771712",
            "sys/fs/cgroup/memory/docker/abc/memory.limit_in_bytes": "1000000000",
        },
    )
    assert host.cpu_quota(root) == 0.5
    assert host.memory(root)["memory_limit_mb"] == 1000
    assert host.container(root) == "docker"


@pytest.mark.parametrize(
    ("files", "kind"), [({".dockerenv": ""}, "docker"), ({"proc/1/cgroup": "0::/\n"}, None), ({}, None)]
)
def test_kinds_of_container(tmp_path: Path, files: dict[str, str], kind: str | None) -> None:
    assert host.container(tree(tmp_path, files)) == kind


def test_hypervisors(tmp_path: Path) -> None:
    assert host.virtual_machine(tree(tmp_path / "a", {"proc/cpuinfo": X86.format(extra=" hypervisor")}))
    assert host.virtual_machine(tree(tmp_path / "b", {"sys/hypervisor/type": "xen"}))
    assert host.virtual_machine(tree(tmp_path / "c", {"proc/cpuinfo": X86.format(extra="")})) is False


def test_odd_content_is_absent(tmp_path: Path) -> None:
    root = tree(tmp_path, {"sys/devices/system/cpu/online": "none", "proc/sys/kernel/arch": "riscv64", "x": "1.5"})
    assert host.online_cores(root) is None
    assert host.architecture(root) == "riscv64"
    assert host.read_number(root, "x") is None
    assert host.read_text(root, "sys") is None


def test_versions_lists_what_is_installed() -> None:
    assert list(host.versions(["no-such-distribution"])) == []
    assert host.versions(["numpy"])["numpy"].count(".") >= 1


def test_processors_that_are_busy_are_counted_over_a_while(tmp_path, monkeypatch):
    (tmp_path / "proc").mkdir()
    (tmp_path / "sys/devices/system/cpu").mkdir(parents=True)
    (tmp_path / "sys/devices/system/cpu/online").write_text("0-3")
    stat = tmp_path / "proc/stat"
    stat.write_text("cpu  100 0 100 1000 50 0 0 10 0 0\ncpu0 1 2\n")
    monkeypatch.setattr(host.time, "sleep", lambda seconds: stat.write_text("cpu  140 0 110 1040 55 0 0 15 0 0\n"))
    assert host.busy_processors(tmp_path) == pytest.approx(4 * 55 / 100)
    assert host.busy_processors(tmp_path) is None, "no tick has passed"
    stat.write_text("cpu  1 2 3\n")
    assert host.busy_processors(tmp_path) is None


def test_processors_of_this_machine_are_between_none_and_all():
    found = host.busy_processors(seconds=0.05)
    assert found is None or 0 <= found <= host.online_cores()


@pytest.mark.parametrize(
    ("said", "driver"),
    [
        ("NVRM version: NVIDIA UNIX x86_64 Kernel Module  550.54.15  Tue Mar  5 22:23:56 UTC 2024\n", "550.54.15"),
        ("NVRM version: NVIDIA UNIX Open Kernel Module for aarch64  540.3.0  Release Build  (bugfix)\n", "540.3.0"),
    ],
)
def test_graphics_cards_and_their_driver(tmp_path: Path, said: str, driver: str) -> None:
    assert (host.gpus(tmp_path), host.gpu_driver(tmp_path)) == ((), None)
    cards = {
        f"proc/driver/nvidia/gpus/0000:0{n}:00.0/information": f"Model: \t\t NVIDIA A{n}\nIRQ: 1\n" for n in (2, 1)
    }
    root = tree(tmp_path, {**cards, "proc/driver/nvidia/version": said})
    assert host.gpus(root) == ("NVIDIA A1", "NVIDIA A2")
    assert host.gpu_driver(root) == f"NVIDIA driver {driver}"


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({}, ""),
        ({"var/lib/nvpmodel/status": "pmode:0002 fmode:quiet\n"}, "nvpmodel 2"),
        (
            {
                "var/lib/nvpmodel/status": "pmode:0002\n",
                "etc/nvpmodel.conf": "< POWER_MODEL ID=0 NAME=MAXN >\nCPU 1\n< POWER_MODEL ID=2 NAME=MODE_30W >\n",
                "sys/devices/system/cpu/cpufreq/policy0/scaling_governor": "schedutil\n",
            },
            "nvpmodel MODE_30W, governor schedutil",
        ),
        ({"sys/firmware/acpi/platform_profile": "low-power\n"}, "platform profile low-power"),
    ],
)
def test_the_power_mode_is_what_the_machine_says(tmp_path: Path, files: dict[str, Any], words: str) -> None:
    assert host.power_mode(tree(tmp_path, files)) == words
