"""The process in which a Bladed-style library lives: standard library only, it starts in 20 ms.

It is run as a program with a JSON description as its only argument. Requests come on standard
input as doubles: one for each record of the swap array that is told. Replies leave on what was
standard output: aviFAIL, the length of the message, the records that are asked for, the message.
What the library prints goes to standard error.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import struct
import sys

# Replies: aviFAIL, length of the message.
HEAD = struct.Struct("<ii")
# aviFAIL that no library sends: it could not be loaded.
NOT_LOADED = -1_000_000
_MESSAGE = 4096


def main(told: dict) -> None:
    """Load the library, then call it for every request until standard input ends."""
    replies = os.dup(1)
    os.dup2(2, 1)
    # Ctrl-C is for the parent, whose end ends this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        function = getattr(ctypes.CDLL(told["library"]), told["procedure"])
    except (OSError, AttributeError) as error:
        text = str(error).encode()
        os.write(replies, HEAD.pack(NOT_LOADED, len(text)) + text)
        return
    os.write(replies, HEAD.pack(0, 0))
    swap = (ctypes.c_float * told["size"])()
    for record, value in told["records"].items():
        swap[int(record) - 1] = value
    texts = [told[name].encode() for name in ("input", "name")]
    buffers = [ctypes.create_string_buffer(text) for text in texts]
    message = ctypes.create_string_buffer(_MESSAGE)
    swap[48], swap[49], swap[50], swap[63] = _MESSAGE, *(len(t) + 1 for t in texts), 1024
    fail = ctypes.c_int32(0)
    arguments = (swap, ctypes.byref(fail), *buffers, message)
    function.restype = None
    request = struct.Struct(f"<{len(told['set'])}d")
    reply = struct.Struct(f"<{len(told['get'])}d")
    places = [record - 1 for record in told["set"]]
    asked = [record - 1 for record in told["get"]]
    while data := _read(request.size):
        for place, value in zip(places, request.unpack(data), strict=True):
            swap[place] = value
        fail.value = 0
        function(*arguments)
        text = message.value if fail.value else b""
        os.write(
            replies,
            HEAD.pack(fail.value, len(text)) + reply.pack(*(swap[i] for i in asked)) + text,
        )


def _read(size: int) -> bytes:
    """So many bytes of standard input, or none at its end."""
    data = b""
    while len(data) < size:
        more = os.read(0, size - len(data))
        if not more:
            return b""
        data += more
    return data


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
