"""Parameters of the console."""

from __future__ import annotations

import dataclasses

from needle_console.access import Access
from needle_core.errors import UserError
from needle_core.settings.parameter_fields import check_fields, fixed_parameter


@dataclasses.dataclass(frozen=True)
class ConsoleParameters:
    """Parameters of the console, fixed at start."""

    address: str = fixed_parameter("127.0.0.1", "-", "Address that page and hold listen on.")
    port: int = fixed_parameter(8080, "-", "Port of the page.", 1, 65535)
    hold_port: int = fixed_parameter(8081, "-", "Port of the hold.", 1, 65535)
    hold_real_rig: bool = fixed_parameter(
        False, "-", "Allow pages on the rig's own machine to hold a real rig; others never may."
    )
    hosts: tuple[str, ...] = fixed_parameter(
        ("",),
        "-",
        "Names and addresses of this machine in browsers; empty: `address`.",
        texts=True,
    )
    calibration_file: str = fixed_parameter(
        "", "-", "Calibration of the cameras, to draw the needle; empty: needle_tracker's."
    )

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises
        ------
        UserError
            If a parameter is out of bounds, or both ports are the same.
        """
        check_fields(self)
        if self.port == self.hold_port:
            raise UserError(f"port and hold_port are both {self.port}, expected two")

    def hold_refusal(self, simulated: bool | None, *, is_local: bool) -> str:
        """Return the reason why a page may only watch and stop; empty if it may hold.

        Parameters
        ----------
        simulated : bool or None
            Whether the device reports that it is simulated; None if unknown.
        is_local : bool
            Whether the page is shown on the rig's own machine.
        """
        if simulated or (self.hold_real_rig and is_local):
            return ""
        if self.hold_real_rig:
            return "watching only: a real rig can be held at its own machine only"
        return "watching only: hold_real_rig is off, and this is not a simulation"

    def access(self) -> Access:
        """Return the access control; errors are those of `Access`."""
        hosts = [host for host in self.hosts if host]
        return Access(self.address, self.port, hosts)
