"""Runs a command with a disk of 4 MB at FOLDER, full until `room` comes on stdin; the command has all other lines.

unshare -rm python small_disk.py FOLDER COMMAND...
"""

from __future__ import annotations

import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path


def main() -> None:
    folder, *command = sys.argv[1:]
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", folder], check=True)
    filled = Path(folder, "others")
    with filled.open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(4096))
        except OSError:
            pass
    process = subprocess.Popen(command, stdin=subprocess.PIPE)
    signal.signal(signal.SIGTERM, lambda *_: process.terminate())
    for line in iter(sys.stdin.buffer.readline, b""):
        if line.strip() == b"room":
            filled.unlink()
        else:
            with suppress(BrokenPipeError):
                process.stdin.write(line)
                process.stdin.flush()
    process.terminate()
    with suppress(BrokenPipeError):
        process.stdin.close()
    sys.exit(process.wait())


if __name__ == "__main__":
    main()
