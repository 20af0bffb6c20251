"""Listening sockets of a policy server: how many clients may be in the middle of their handshake.

A client that connects and says nothing costs a descriptor until its handshake times out. Without a limit a
hundred of them leave none for other clients, and asyncio logs a traceback for each attempt to accept another.
"""

from __future__ import annotations

import errno
import os
import socket
from collections import OrderedDict
from contextlib import suppress
from typing import Any

MAX_OPENING = 64
"""Sockets that have not finished their handshake, at most: the oldest gives way to the next."""
_OUT_OF_SOCKETS = {errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM}
_NOT_HERE = {errno.EAFNOSUPPORT, errno.EADDRNOTAVAIL}
"""A host may have addresses of a family that this machine lacks."""


class OpeningSockets:
    """Accepted sockets that have not finished their handshake.

    There are at most `MAX_OPENING`: a new one closes the oldest.
    """

    def __init__(self):
        self._opening: dict[int, socket.socket] = {}
        self._spare: int | None = os.open(os.devnull, os.O_RDONLY)
        self._listening: list[ListeningSocket] = []

    def listen(self, host: str, port: int) -> list[ListeningSocket]:
        """Returns a listening socket for each address of a host.

        Raises:
            OSError: an address cannot be used.
        """
        infos = socket.getaddrinfo(host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        missing: OSError | None = None
        for family, kind, protocol, _, address in OrderedDict.fromkeys(infos):
            try:
                listening = ListeningSocket(family, kind, protocol)
                self._listening.append(listening)
                listening.sockets = self
                listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                if family == socket.AF_INET6:
                    listening.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
                listening.bind(address)
            except OSError as err:
                if err.errno not in _NOT_HERE:
                    raise
                missing = err
        bound = [listening for listening in self._listening if listening.getsockname()[1]]
        if not bound and missing is not None:
            raise missing
        return bound

    def close(self) -> None:
        """Closes the listening sockets, and the spare descriptor."""
        for listening in self._listening:
            listening.close()
        self._drop_spare()

    def add(self, accepted: AcceptedSocket) -> None:
        """Notes a new socket, and ends the oldest where there are too many."""
        accepted.sockets, accepted.number = self, accepted.fileno()
        self._opening[accepted.number] = accepted
        while len(self._opening) > MAX_OPENING:
            self._end_oldest()

    def finished(self, number: int) -> None:
        """Takes a socket off the list: its handshake is done, or it is closed.

        Args:
            number: its file descriptor.
        """
        self._opening.pop(number, None)

    def shed(self, listening: socket.socket) -> None:
        """Refuses one client when the process has no descriptor left.

        Without it the event loop would find the same client waiting again and again.
        """
        self._drop_spare()
        with suppress(OSError):
            socket.socket.accept(listening)[0].close()
        with suppress(OSError):
            self._spare = os.open(os.devnull, os.O_RDONLY)
        if self._opening:
            self._end_oldest()

    def _end_oldest(self) -> None:
        oldest = self._opening.pop(next(iter(self._opening)))
        # Its transport reads the end of the stream, and closes it.
        with suppress(OSError):
            oldest.shutdown(socket.SHUT_RDWR)

    def _drop_spare(self) -> None:
        if self._spare is not None:
            os.close(self._spare)
            self._spare = None


class ListeningSocket(socket.socket):
    """A listening socket whose clients are counted until their handshake is done."""

    sockets: OpeningSockets

    def accept(self) -> tuple[socket.socket, Any]:
        """Accepts a client; see `socket.socket.accept`.

        Raises:
            BlockingIOError: there is none, or no descriptor for it.
        """
        try:
            accepted, address = super().accept()
        except OSError as err:
            if err.errno not in _OUT_OF_SOCKETS:
                raise
            self.sockets.shed(self)
            raise BlockingIOError from err
        counted = AcceptedSocket(accepted.family, accepted.type, accepted.proto, fileno=accepted.detach())
        self.sockets.add(counted)
        return counted, address


class AcceptedSocket(socket.socket):
    """A client's socket."""

    sockets: OpeningSockets
    number: int

    def close(self) -> None:
        self.sockets.finished(self.number)
        super().close()
