"""A run connects to no other computer, nor do the native libraries that it loads: the kernel would end the process."""

import ctypes
import os
import platform
import signal
import struct
import subprocess
import sys

import pytest

SOCKET = {"x86_64": 41, "aarch64": 198}.get(platform.machine())  # number of the system call
NO_NEW_PRIVILEGES, SECCOMP, FILTER = 38, 22, 2
LOAD, IF_EQUAL, RETURN = 0x20, 0x15, 0x06
ALLOW, KILL_PROCESS = 0x7FFF0000, 0x80000000
FAMILIES = 2, 10  # IPv4 and IPv6

pytestmark = pytest.mark.skipif(sys.platform != "linux" or SOCKET is None, reason="needs Linux's seccomp")


def forbid_the_internet():
    """From now on, a socket of the Internet ends this process."""
    number, family = 0, 16  # offsets in what the kernel hands to the filter
    code = [
        (LOAD, 0, 0, number), (IF_EQUAL, 0, 4, SOCKET), (LOAD, 0, 0, family),
        (IF_EQUAL, 1, 0, FAMILIES[0]), (IF_EQUAL, 0, 1, FAMILIES[1]), (RETURN, 0, 0, KILL_PROCESS),
        (RETURN, 0, 0, ALLOW),
    ]  # fmt: skip
    lines = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *line) for line in code))
    program = struct.pack("HxxxxxxP", len(code), ctypes.addressof(lines))
    prctl = ctypes.CDLL(None, use_errno=True).prctl
    if prctl(NO_NEW_PRIVILEGES, 1, 0, 0, 0) or prctl(SECCOMP, FILTER, program, 0, 0):
        raise OSError(ctypes.get_errno(), "seccomp")


def run_offline(*arguments, home):
    """A Python process that may not reach the Internet, with an empty home."""
    home.mkdir()
    given = {name: value for name, value in os.environ.items() if not name.startswith(("ORT_", "XDG_"))}
    try:
        return subprocess.run(
            [sys.executable, *map(str, arguments)], env={**given, "HOME": str(home)}, preexec_fn=forbid_the_internet,
            capture_output=True, text=True, check=False, timeout=300,
        )  # fmt: skip
    except subprocess.SubprocessError:
        pytest.skip("seccomp is not allowed here")


@pytest.mark.parametrize("family", ["AF_INET", "AF_INET6"])
def test_a_socket_of_the_internet_would_be_noticed(tmp_path, family):
    opened = f"import socket; socket.socket(socket.AF_UNIX).close(); print(1); socket.socket(socket.{family})"
    found = run_offline("-uc", opened, home=tmp_path / "home")
    assert (found.returncode, found.stdout) == (-signal.SIGSYS, "1\n")


def test_a_network_prints_nothing_and_leaves_home_empty(tmp_path):
    shipped = "files('conformodal.features').joinpath('shipped', 'xfeat.onnx').read_bytes()"
    opened = f"from importlib.resources import files; open_session({shipped})"
    found = run_offline("-c", f"from conformodal.features.backbone import open_session; {opened}", home=tmp_path / "h")
    assert (found.returncode, found.stdout, found.stderr) == (0, "", "")
    assert not list((tmp_path / "h").iterdir())


def test_a_run_on_files_opens_no_socket_of_the_internet(small_world, tmp_path):
    arguments = ["run", small_world.model, small_world.folder, "--limit", 30, "--out", tmp_path / "out"]
    found = run_offline("-m", "conformodal", *arguments, home=tmp_path / "home")
    assert found.returncode == 0, found.stderr
    assert not list((tmp_path / "home").iterdir())
    assert (tmp_path / "out" / "report.html").is_file()
