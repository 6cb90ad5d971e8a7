"""Runs a command in a network namespace of its own, on an Ethernet whose other end it sends to a Unix socket.

unshare -rn python namespaced.py SOCKET ADDRESS/BITS[@FILE][,...] COMMAND...

An address with a file comes when that is there, after the command, in place of the one before.
"""

from __future__ import annotations

import fcntl
import os
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

DEVICE = "/dev/net/tun"
TUNSETIFF, IFF_TAP, IFF_NO_PI = 0x400454CA, 0x0002, 0x1000


def main() -> None:
    path, addresses, *command = sys.argv[1:]
    port = os.open(DEVICE, os.O_RDWR)
    fcntl.ioctl(port, TUNSETIFF, struct.pack("16sH22x", b"eth0", IFF_TAP | IFF_NO_PI))
    for words in ("link set lo up", "link set eth0 up"):
        subprocess.run(["ip", *words.split()], check=True)
    for address, _, later in (text.partition("@") for text in addresses.split(",")):
        if not later or os.fork() == 0:
            while later and not Path(later).exists():
                time.sleep(0.1)
            subprocess.run(["ip", "addr", "flush", "dev", "eth0"], check=True)
            subprocess.run(["ip", "addr", "add", *address.split(), "dev", "eth0"], check=True)
            if later:
                os._exit(0)
    with socket.socket(socket.AF_UNIX) as parent:
        parent.connect(path)
        socket.send_fds(parent, [b"port"], [port])
    os.close(port)
    if command:
        os.execvp(command[0], command)


if __name__ == "__main__":
    main()
