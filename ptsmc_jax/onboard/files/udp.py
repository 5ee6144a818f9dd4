"""The exported controller as a process behind UDP, for a simulator in Python. `make udp` builds the process.

>>> controller = Controller("out/controller")
>>> status, out = controller.step(t=0.0, **readings)  # every period; arrays or lists by name, such as attitude=[..]
>>> out["command[0]"]
"""

import json
import socket
import struct
from pathlib import Path


class Controller:
    """A connection to `./udp PORT` in the folder of an exported controller."""

    def __init__(self, folder, port=5005, timeout=1.0):
        columns = json.loads((Path(folder) / "controller.json").read_text())["columns"]
        self.inputs, self.outputs = columns["in"], columns["out"]
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.settimeout(timeout)  # [s]
        self.socket.connect(("127.0.0.1", port))

    def reset(self):
        """Begin a run."""
        self._ask(b"")

    def step(self, **values):
        """Return the status of a sample and its outputs by name, for the inputs by name, such as t and attitude."""
        given = []
        for column in self.inputs:
            name, *places = column.replace("]", "").split("[")
            value = values[name]
            for place in places:
                value = value[int(place)]
            given.append(float(value))
        status, *out = self._ask(struct.pack(f"{len(given)}d", *given))
        return int(status), dict(zip(self.outputs, out, strict=True))

    def _ask(self, message):
        self.socket.send(message)
        return struct.unpack(f"{1 + len(self.outputs)}d", self.socket.recv(65536))
