"""An openpi policy server in one file: Python 3.9, numpy, msgpack and websockets 13 are all it needs.

For policies that cannot live in one environment with LeRobot: run it, with a few lines around it, in theirs
(`being_h05_libero.py` and its neighbours do), and ask it with `--policy.type=roborecover_remote`.
"""

from __future__ import annotations

import hmac
import http
import inspect
import os
import re
import sys
import threading
import time
import traceback

import msgpack
import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import serve as listen

KINDS = "biuf"
DTYPE = re.compile(r"[<>|=]?([biu][1248]|f[248])|bool|u?int(8|16|32|64)|float(16|32|64)")
API_KEY = "ROBORECOVER_API_KEY"
LOOPBACK = ("127.0.0.1", "::1", "localhost")
LIMITS = {"max_array_len": 4096, "max_map_len": 4096, "max_str_len": 2**20, "max_ext_len": 0}
MOST_VALUES = 65536
"""Values of all lists and maps of a request: a byte on the wire may be sixty in memory. An array is one."""
MIN_KEY_CHARS = 16
MAX_CONNECTIONS = 16
"""At once; each may hold a frame or two."""
WRONG_KEY_DELAY_S = 1.0


def encode(value):
    """msgpack's `default`: arrays as openpi packs them."""
    if isinstance(value, (np.ndarray, np.generic)) and value.dtype.kind not in KINDS:
        raise ValueError(f"arrays of dtype {value.dtype} are not sent")
    if isinstance(value, np.ndarray):
        return {
            b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape,
        }  # fmt: skip
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"a {type(value).__name__} is not sent")


def decode(value):
    """msgpack's `object_hook`: arrays of numbers, never of objects."""
    if b"__ndarray__" not in value and b"__npgeneric__" not in value:
        return value
    if not DTYPE.fullmatch(str(value[b"dtype"])):
        raise ValueError(f"arrays of dtype {value[b'dtype']!r:.60} are not taken")
    dtype = np.dtype(value[b"dtype"])
    if b"__npgeneric__" in value:
        return dtype.type(value[b"data"])
    return np.frombuffer(value[b"data"], dtype).reshape(value[b"shape"]).copy()


def unpack(message):
    """Returns the request of a frame; raises ValueError where it holds more values than any request."""
    left = [MOST_VALUES]

    def count(values):
        left[0] -= values
        if left[0] < 0:
            raise ValueError(f"more than {MOST_VALUES} values in lists and maps; send numbers as arrays")

    def read_map(content):
        count(2 * len(content) + 1)
        return decode(content)

    def read_list(content):
        count(len(content) + 1)
        return content

    return msgpack.unpackb(message, object_hook=read_map, list_hook=read_list, **LIMITS)


def printable(text):
    """Returns text of a client with control characters, which a terminal obeys, written as escapes."""
    return "".join(
        c if c.isprintable() or c == "\n" else c.encode("unicode_escape", "surrogatepass").decode()
        for c in text
    )


def serve(infer, metadata=None, host="127.0.0.1", port=8000, max_frame_mb=64, started=None, insecure=False):
    """Serves for ever.

    Where the environment variable ROBORECOVER_API_KEY is set, clients must send it (RoboRecover's do, where
    it is set for them; openpi's have `api_key`). Browsers are refused.

    Args:
        infer: called with a request, a dict; returns a dict, with `actions` an (n, A) array. One at a time.
        metadata: sent to every client that connects.
        host: address to listen on; beyond the loopback a key is needed.
        port: 0 takes a free one.
        max_frame_mb: of a request.
        started: called with the server, if given.
        insecure: listen beyond the loopback without a key.
    """
    one_at_a_time, slow, wrong_keys = threading.Lock(), threading.Lock(), [0]
    free = threading.BoundedSemaphore(MAX_CONNECTIONS)
    key = os.environ.get(API_KEY)
    if key is not None and not key.strip():
        raise SystemExit(f"{API_KEY} is set and empty: give it a value, or unset it")
    if key is not None and len(key) < MIN_KEY_CHARS:
        raise SystemExit(
            f"{API_KEY} has {len(key)} characters; a server's key has {MIN_KEY_CHARS} or more. Make one: "
            "openssl rand -hex 16"
        )
    if key is None and host not in LOOPBACK and not insecure:
        raise SystemExit(
            f"host {host}: any client that reaches this address could use the policy. Set {API_KEY} here and "
            "at the client, or listen on 127.0.0.1 and use an SSH tunnel, or call serve(..., insecure=True)"
        )

    def admit(connection, request):
        if request.headers.get_all("Origin"):
            return connection.respond(http.HTTPStatus.FORBIDDEN, "no requests from web pages\n")
        if request.path == "/healthz":
            return connection.respond(http.HTTPStatus.OK, "OK\n")
        given = request.headers.get_all("Authorization")
        if key is not None and not (
            len(given) == 1
            and hmac.compare_digest(given[0].encode("utf-8", "surrogateescape"), f"Api-Key {key}".encode())
        ):
            with slow:  # wrong keys wait for each other
                wrong_keys[0] += 1
                if wrong_keys[0] & (wrong_keys[0] - 1) == 0:
                    peer = connection.remote_address[0]
                    print(f"wrong or missing API key from {peer}; {wrong_keys[0]} so far", flush=True)
                time.sleep(WRONG_KEY_DELAY_S)
            return connection.respond(http.HTTPStatus.UNAUTHORIZED, "wrong or missing API key\n")
        return None

    def answer(message):
        try:
            if isinstance(message, str):
                raise ValueError("a text frame; requests are binary")
            with one_at_a_time:
                request = unpack(message)
                began = time.monotonic()
                result = dict(infer(request))
            result["server_timing"] = {"infer_ms": 1000 * (time.monotonic() - began)}
            return msgpack.packb(result, default=encode)
        except Exception as error:  # an error belongs to its request; where it was is for this side to read
            print(printable(traceback.format_exc()), file=sys.stderr, flush=True)
            return f"{type(error).__name__}: {error}"

    def handle(connection):
        if not free.acquire(blocking=False):
            connection.close(1013, f"{MAX_CONNECTIONS} connections are all that are taken")
            return
        try:
            connection.send(msgpack.packb(metadata or {}, default=encode))
            for message in connection:
                connection.send(answer(message))
        except ConnectionClosed:
            pass
        finally:
            free.release()

    size = max_frame_mb * 2**20
    options = {"compression": None, "max_size": size, "process_request": admit}
    if "max_queue" in inspect.signature(listen).parameters:  # websockets 13 keeps one message anyway
        options["max_queue"] = 2
    with listen(handle, host, port, **options) as server:
        print(f"serving at ws://{host}:{server.socket.getsockname()[1]}", flush=True)
        if started is not None:
            started(server)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print("stopped", flush=True)
