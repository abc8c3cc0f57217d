"""A browser that draws nothing: it speaks with a page over a real websocket, and knows its controls by their labels."""

import socket
import threading
import time
from importlib.metadata import version

import msgpack
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (1.0, 1.0, 1.0), "fov": 1.0, "near": 0.01,
    "far": 100.0, "image_height": 480, "image_width": 640, "look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0),
}  # fmt: skip


def waited(what, seconds=20.0):
    """What becomes true in time."""
    until = time.monotonic() + seconds
    while not (found := what()):
        assert time.monotonic() < until, "it takes too long"
        time.sleep(0.01)
    return found


class Browser:
    """A page that is open; `notices` has what it was told."""

    def __init__(self, host, port):
        self._parts, self.notices = {}, []
        speaks = [Subprotocol(f"viser-v{version('viser')}")]
        connection = socket.create_connection((host, port))
        self._page = connect(f"ws://{host}:{port}", sock=connection, subprotocols=speaks, max_size=None)
        threading.Thread(target=self._read, daemon=True).start()
        self._send(CAMERA)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()

    def close(self):
        self._page.close()

    def has(self, label):
        """Whether a control is there."""
        return self._find(label) is not None

    def value(self, label):
        """What a control shows."""
        return waited(lambda: self._find(label))["value"]

    def says(self, text):
        """Whether a text is on the page."""
        return any(text in str(part["props"].get("_markdown", "")) for part in [*self._parts.values()])

    def press(self, label):
        self._update(label, True)

    def enter(self, label, value):
        """Change the value of a control."""
        waited(lambda: self._find(label))["value"] = value
        self._update(label, value)

    def hold(self, label, frequency=20.0):
        """One of the signs of life of a button that is held."""
        self._send({"type": "GuiButtonHoldMessage", "uuid": waited(lambda: self._find(label))["uuid"], "frequency": frequency})

    def _find(self, label):
        return next((part for part in [*self._parts.values()] if part["props"].get("label") == label), None)

    def _update(self, label, value):
        uuid = waited(lambda: self._find(label))["uuid"]
        self._send({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}})

    def _send(self, message):
        self._page.send(msgpack.packb(message))

    def _read(self):
        unpack = zstandard.ZstdDecompressor().decompress
        try:
            for frame in self._page:
                size = int.from_bytes(frame[8:16], "little")
                for told in msgpack.unpackb(unpack(frame[16 : 16 + size]))["messages"]:
                    self._take(told)
        except ConnectionClosed:
            pass

    def _take(self, told):
        if told["type"] == "GuiRemoveMessage":
            self._parts.pop(told["uuid"], None)
        elif told["type"] == "GuiUpdateMessage" and (part := self._parts.get(told["uuid"])) is not None:
            part.update({name: value for name, value in told["updates"].items() if name == "value"})
            part["props"].update(told["updates"])
        elif told["type"] == "NotificationShowMessage":
            self.notices.append(told["props"]["body"])
        elif "container_uuid" in told and "props" in told:
            self._parts[told["uuid"]] = told
