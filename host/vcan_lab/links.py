"""vcan interfaces by rtnetlink, in network namespaces.  Standard library alone.

Failure: ``OSError`` with the kernel's reason.  Layouts: rtnetlink(7), linux/if_link.h, linux/sched.h.
"""

from __future__ import annotations

import ctypes
import errno
import os
import socket
import struct
from collections.abc import Iterable
from pathlib import Path

_RTM_NEWLINK = 16
_REQUEST_ACK = 0x5
_CREATE_EXCLUSIVE = 0x600
_IFLA_IFNAME, _IFLA_LINKINFO, _IFLA_INFO_KIND = 3, 18, 1
_IFF_UP = 1
_CLONE_NEWUSER, _CLONE_NEWNET = 0x1000_0000, 0x4000_0000
_HEADER_LEN = 16


def state(name: str) -> str | None:
    """Say why the CAN interface ``name`` cannot be used; None when it exists and is up."""
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as can:
            can.bind((name,))
            pending = can.getsockopt(
                socket.SOL_SOCKET, socket.SO_ERROR
            )  # binding to an interface that is down succeeds
    except OSError as reason:
        pending = reason.errno or errno.EIO
    return os.strerror(pending) if pending else None


def create(names: Iterable[str]) -> None:
    """Create the vcan interfaces ``names``; bring them and the loopback up."""
    names = tuple(names)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, 0) as netlink:
        netlink.bind((0, 0))
        for name in names:
            kind = _attribute(_IFLA_LINKINFO, _attribute(_IFLA_INFO_KIND, b"vcan\0"))
            body = _interface(0, 0) + _attribute(_IFLA_IFNAME, name.encode() + b"\0") + kind
            _request(netlink, _CREATE_EXCLUSIVE, body, f"vcan interface {name}")
        for name in ("lo", *names):
            _request(netlink, 0, _interface(socket.if_nametoindex(name), _IFF_UP), f"bring {name} up")


def enter_namespace(names: Iterable[str], as_root: bool) -> None:
    """Move this process into a new network namespace with vcan interfaces ``names``.

    Without root this also creates a user namespace, in which the caller keeps its id or, with ``as_root``, is root.
    """
    uid, gid = os.getuid(), os.getgid()
    flags = _CLONE_NEWNET if uid == 0 else _CLONE_NEWNET | _CLONE_NEWUSER
    if ctypes.CDLL(None, use_errno=True).unshare(flags):
        number = ctypes.get_errno()
        raise OSError(number, f"network namespace: {os.strerror(number)}")
    if uid:
        Path("/proc/self/setgroups").write_text("deny")
        Path("/proc/self/gid_map").write_text(f"{0 if as_root else gid} {gid} 1")
        Path("/proc/self/uid_map").write_text(f"{0 if as_root else uid} {uid} 1")
    create(names)


def _attribute(kind: int, data: bytes) -> bytes:
    length = 4 + len(data)
    return struct.pack("HH", length, kind) + data + bytes(-length % 4)


def _interface(index: int, flags: int) -> bytes:
    return struct.pack("BxHiII", 0, 0, index, flags, flags)


def _request(netlink: socket.socket, flags: int, body: bytes, what: str) -> None:
    netlink.send(struct.pack("IHHII", _HEADER_LEN + len(body), _RTM_NEWLINK, flags | _REQUEST_ACK, 1, 0) + body)
    number = -struct.unpack_from("i", netlink.recv(4096), _HEADER_LEN)[0]
    if number:
        raise OSError(number, f"{what}: {os.strerror(number)}")
