"""The CAN bus at a component's port: frames come and go in batches, between handlers."""

from __future__ import annotations

from collections.abc import Iterable

from needle_core.can_frame import CanFrame
from needle_device_driver.link.frame_link import FrameLink, LinkError
from needle_device_driver.link.link_settings import LinkSettings


class PortLink(FrameLink):
    """A link without an adapter: whoever runs the component carries its frames.

    What is lost stays lost until it is opened again, for the drives have missed something.

    Parameters
    ----------
    settings : LinkSettings
        Only their text counts.

    Attributes
    ----------
    now : float
        Steady time of the handler that runs [s].
    """

    def __init__(self, settings: LinkSettings) -> None:
        self.now = 0.0
        super().__init__(settings, lambda: self.now)
        self._is_open = False
        self._why_not = ""
        self._sent: list[CanFrame] = []

    @property
    def is_open(self) -> bool:
        """Tell whether frames pass."""
        return self._is_open and not self.lost

    def open(self) -> None:
        """Let frames pass.

        Raises
        ------
        LinkError
            If the port is not open.
        """
        if self.is_open:
            return
        if self._why_not:
            raise LinkError(f"cannot open {self.settings}: {self._why_not}")
        self._is_open = True
        self._note_opening()

    def change(self, why_not: str) -> None:
        """Take that the port is open, or why it is not."""
        self._why_not = why_not
        if why_not and self.is_open:
            self.lost = f"link {self.settings} is lost: {why_not}"

    def close(self) -> None:
        """Let no frame pass."""
        self._is_open = False

    def send(self, cob_id: int, data: bytes = b"") -> None:
        """Send one frame with the batch of the handler that runs.

        Raises
        ------
        LinkError
            If the link is closed or lost.
        """
        if not self.is_open:
            raise LinkError(self.lost or f"{self.settings} is not open")
        self._sent.append(CanFrame(cob_id, data))
        self.frames_sent += 1

    def take_sent(self) -> tuple[CanFrame, ...]:
        """Return the frames that were sent since the last call."""
        frames = tuple(self._sent)
        self._sent.clear()
        return frames

    def receive(self, frames: Iterable[CanFrame]) -> None:
        """Take frames off the bus."""
        for frame in frames:
            if self.is_open and not frame.remote:
                self._take(frame.identifier, frame.data, self.now)
