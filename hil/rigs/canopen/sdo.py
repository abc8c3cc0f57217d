"""Nodes as the controller reads and configures them: over SDO, with every value read back."""

import struct
import time
from collections.abc import Callable
from typing import Any

import can
import canopen
from canopen.sdo import SdoAbortedError, SdoClient, SdoCommunicationError

from hil.rigs import RigError
from hil.rigs.canopen.frames import CobId
from hil.rigs.canopen.objects import COB_ID, INVALID_COB_ID, TRANSMISSION_TYPE, Pdo
from hil.rigs.canopen.settings import object_dictionary

BUS_ERRORS = (can.CanError, OSError, ValueError)
"""What python-can raises when a bus fails."""

MOST_DRAINED = 256
"""The largest number of old frames that are read at once."""

_SDO_ATTEMPTS = 3


class _Sdo(SdoClient):  # type: ignore[misc]
    """canopen's SDO client, but it reads the bus itself instead of having a thread do it."""

    RESPONSE_TIMEOUT = 1.0

    def __init__(self, node: int, eds: Any, network: canopen.Network, receive: Callable[[float], can.Message | None]) -> None:
        super().__init__(CobId.SDO_REQUEST + node, CobId.SDO_ANSWER + node, object_dictionary(eds, node))
        self.network = network
        self._receive = receive

    def send_request(self, request: bytes) -> None:
        # Frames that an earlier request has left are no answer to this one.
        for _ in range(MOST_DRAINED):
            if self._receive(0.0) is None:
                break
        super().send_request(request)

    def read_response(self) -> bytes:
        deadline = time.monotonic() + self.RESPONSE_TIMEOUT
        while self.responses.empty():
            left = deadline - time.monotonic()
            if left <= 0.0:
                raise SdoCommunicationError("no answer")
            message = self._receive(left)
            if message is not None and message.arbitration_id == self.tx_cobid and len(message.data) == 8:
                self.responses.put(bytes(message.data))
        response: bytes = super().read_response()
        return response


class RemoteNode:
    """A node on the bus.

    Args:
        name: for messages, such as drive 0.
        node: its id.
        eds: electronic data sheet.
        network: canopen's.
        receive: returns the next frame within a time [s], or None.
    """

    def __init__(
        self, name: str, node: int, eds: Any, network: canopen.Network, receive: Callable[[float], can.Message | None]
    ) -> None:  # fmt: skip
        self.name, self.node = f"{name} (node {node})", node
        self._sdo = _Sdo(node, eds, network, receive)

    def has(self, index: int, subindex: int = 0) -> bool:
        """Whether the EDS has this object."""
        return self._sdo.od.get_variable(index, subindex) is not None

    def expected(self, index: int, subindex: int = 0) -> Any:
        """The value of an object in the EDS."""
        return self._variable(index, subindex).default

    def read(self, index: int, subindex: int = 0) -> Any:
        """The value of an object.

        Raises:
            RigError: the node does not answer or refuses.
        """
        variable = self._variable(index, subindex)
        return self._transfer(
            lambda: variable.decode_raw(self._sdo.upload(index, subindex)), f"to give object {_named(index, subindex)}"
        )

    def write(self, index: int, subindex: int, value: int) -> None:
        """Write an object.

        Raises:
            RigError: the node does not answer or refuses.
        """
        data = self._variable(index, subindex).encode_raw(value)
        purpose = f"{_shown(value)} for object {_named(index, subindex)}"
        self._transfer(lambda: self._sdo.download(index, subindex, data), purpose)

    def check(self, index: int, subindex: int, value: Any, within: float = 0.0) -> None:
        """Check that an object has this value, or takes it within a time [s].

        Raises:
            RigError: it has another.
        """
        deadline = time.monotonic() + within
        found = self.read(index, subindex)
        while found != value and time.monotonic() < deadline:
            found = self.read(index, subindex)
        if found != value:
            raise RigError(
                f"{self.name} has {_shown(found)} in object {_named(index, subindex)}; it must be {_shown(value)}: "
                "check that it is the right device with the right firmware"
            )

    def configure(self, index: int, subindex: int, value: int) -> None:
        """Write an object and check that the node has accepted it."""
        self.write(index, subindex, value)
        self.check(index, subindex, value)

    def map_pdo(self, pdo: Pdo) -> None:
        """Configure a PDO and check all of it."""
        cob_id = pdo.cob_id + self.node
        self.write(pdo.communication, COB_ID, cob_id | INVALID_COB_ID)
        self.write(pdo.mapping, 0, 0)
        for i, entry in enumerate(pdo.objects):
            self.write(pdo.mapping, i + 1, entry)
        self.configure(pdo.mapping, 0, len(pdo.objects))
        for i, entry in enumerate(pdo.objects):
            self.check(pdo.mapping, i + 1, entry)
        self.configure(pdo.communication, TRANSMISSION_TYPE, pdo.transmission_type)
        self.configure(pdo.communication, COB_ID, cob_id)

    def _variable(self, index: int, subindex: int) -> Any:
        variable = self._sdo.od.get_variable(index, subindex)
        if variable is None:
            raise RigError(f"{self.name} needs object {_named(index, subindex)}, which its EDS does not have: check the EDS")
        return variable

    def _transfer(self, transfer: Callable[[], Any], purpose: str) -> Any:
        reason: Exception | None = None
        for _ in range(_SDO_ATTEMPTS):
            try:
                return transfer()
            except SdoAbortedError as error:
                raise RigError(f"{self.name} refuses {purpose}: {error}; check its EDS") from None
            except (SdoCommunicationError, struct.error, *BUS_ERRORS) as error:
                reason = error
        raise RigError(f"{self.name} does not answer over SDO: {reason}; check its power, wiring and bit rate")


def _named(index: int, subindex: int) -> str:
    return f"{index:04X}h:{subindex:02X}"


def _shown(value: Any) -> str:
    return f"0x{value & 0xFFFFFFFF:X}" if isinstance(value, int) else repr(value)
