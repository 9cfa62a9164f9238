import platform
import subprocess
import sys

import pytest

# Blocks of 4 kB, all but every hundredth freed again: those that stay keep the C library from returning the others.
FREED = """
from pathlib import Path
from conformodal.core.parallel import release_freed_memory

def resident_mb():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6

blocks = [bytearray(4000) for _ in range(30_000)]
blocks = blocks[::100]
before = resident_mb()
release_freed_memory()
print(before - resident_mb())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries have no such call")
def test_freed_memory_goes_back_to_the_system():
    done = subprocess.run([sys.executable, "-c", FREED], check=True, capture_output=True, text=True)
    assert float(done.stdout) > 50  # of 120 MB
