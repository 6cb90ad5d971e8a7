"""Runs a command in a network namespace of its own, on an Ethernet whose other end it sends to a Unix socket.

unshare -rn python namespaced.py SOCKET ADDRESS/BITS COMMAND...
"""

from __future__ import annotations

import fcntl
import os
import socket
import struct
import subprocess
import sys

DEVICE = "/dev/net/tun"
TUNSETIFF, IFF_TAP, IFF_NO_PI = 0x400454CA, 0x0002, 0x1000


def main() -> None:
    path, address, *command = sys.argv[1:]
    port = os.open(DEVICE, os.O_RDWR)
    fcntl.ioctl(port, TUNSETIFF, struct.pack("16sH22x", b"eth0", IFF_TAP | IFF_NO_PI))
    for words in ("link set lo up", f"addr add {address} dev eth0", "link set eth0 up"):
        subprocess.run(["ip", *words.split()], check=True)
    with socket.socket(socket.AF_UNIX) as parent:
        parent.connect(path)
        socket.send_fds(parent, [b"port"], [port])
    os.close(port)
    if command:
        os.execvp(command[0], command)


if __name__ == "__main__":
    main()
