"""The `tracked_tip` executable."""

from __future__ import annotations

import socket
import sys
from collections.abc import Mapping

from needle_core.component import RealPort
from needle_core.errors import UserError
from needle_core.ports.byte_port import BytePort, TcpStream
from needle_core.ros.main import run_component
from needle_tracker import tracked_tip as node

HELP = """
tracked_tip: publishes the needle's tip as an electromagnetic or optical tracker measures it.

Receives    OpenIGTLink TRANSFORM (of PlusServer: in mm), tracker/pose (PoseStamped) or
            tracker/transform (TransformStamped); joint_states
Publishes   needle/tip, needle/tip_pose, /diagnostics (counts of what is no tip, by fault)

`ros2 run needle_tracker register_tracker` writes registration_file. While another node publishes
needle/tip, this one publishes none.
"""
_WAKE_UP_PERIOD, _CONNECT_TIMEOUT = 0.2, 1.0  # [s]


class TransformPort(BytePort):
    """Receives bytes from one peer at a time, and reconnects after a loss.

    Parameters
    ----------
    address : str
        HOST:PORT to connect to, or to listen on.
    listens : bool
        Whether the tracker's software connects to this computer.

    Attributes
    ----------
    address : tuple
        Host and port.

    Raises
    ------
    UserError
        An address that is not HOST:PORT, or not available to listen on.
    """

    def __init__(self, address: str, *, listens: bool) -> None:
        super().__init__()
        self._server: socket.socket | None = None
        host, _, port = address.rpartition(":")
        try:
            self.address = (host, int(port))
            if listens:
                self._server = socket.create_server(self.address)
                self._server.settimeout(_WAKE_UP_PERIOD)
                self.address = self._server.getsockname()
        except (OSError, ValueError, OverflowError) as error:
            raise UserError(f"address = {address!r}: {error}") from error

    def close(self) -> None:
        """Disconnect."""
        super().close()
        if self._server is not None:
            self._server.close()

    def _open_device(self) -> TcpStream:
        if self._server is not None:
            return TcpStream(self._server.accept()[0], _WAKE_UP_PERIOD)
        connection = socket.create_connection(self.address, timeout=_CONNECT_TIMEOUT)
        return TcpStream(connection, _WAKE_UP_PERIOD)


def ports(settings: node.TrackedTipParameters) -> Mapping[str, RealPort]:
    """Return the connection to the tracker, unless the source is a topic."""
    if settings.source in (node.POSE, node.TRANSFORM):
        return {}
    return {node.TRACKER: TransformPort(settings.address, listens=settings.source == node.SERVER)}


def main() -> int:
    """Run the node; returns its exit code."""
    return run_component(
        node.TrackedTip.name,
        node.TrackedTipParameters,
        node.make_tracked_tip,
        help_text=HELP,
        ports=ports,
    )


if __name__ == "__main__":
    sys.exit(main())
