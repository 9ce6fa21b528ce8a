"""The console's parameters."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from needle_console.access.access import Access
from needle_core.errors import UserError
from needle_core.settings.parameter_fields import check_fields, fixed_parameter


@dataclasses.dataclass(frozen=True)
class ConsoleParameters:
    """Parameters of the console, fixed at start."""

    address: str = fixed_parameter(
        "127.0.0.1", "-", "Where page and hold are served; beyond loopback only with a token."
    )
    port: int = fixed_parameter(8080, "-", "Port of the page.", 1, 65535)
    hold_port: int = fixed_parameter(8081, "-", "Port of the hold.", 1, 65535)
    token_file: str = fixed_parameter(
        "", "-", "File whose first line is the token that a page has to know; empty: none."
    )
    hosts: tuple[str, ...] = fixed_parameter(
        ("",),
        "-",
        "Names and addresses by which browsers reach this machine; empty: the address.",
        texts=True,
    )
    calibration_file: str = fixed_parameter(
        "", "-", "Calibration of the cameras, to draw the needle in; empty: needle_tracker's own."
    )

    def __post_init__(self) -> None:
        """Refuse what cannot be served.

        Raises
        ------
        UserError
            A parameter out of bounds, or one port for both.
        """
        check_fields(self)
        if self.port == self.hold_port:
            raise UserError(f"port and hold_port are both {self.port}, wants two")

    def token(self) -> str:
        """Return the token that a page has to know; empty: none.

        Raises
        ------
        UserError
            The file cannot be read, or does not begin with one.
        """
        if not self.token_file:
            return ""
        try:
            lines = Path(self.token_file).expanduser().read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise UserError(f"token_file = {self.token_file!r} cannot be read: {error}") from error
        if not lines or not lines[0].strip():
            raise UserError(f"token_file = {self.token_file!r} has no first line")
        return lines[0].strip()

    def access(self) -> Access:
        """Return who may connect; errors as of `Access` and `token`."""
        hosts = [host for host in self.hosts if host]
        return Access(self.address, self.port, self.token(), hosts)
