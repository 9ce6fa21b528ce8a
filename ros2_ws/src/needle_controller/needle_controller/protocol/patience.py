"""Waits for what has not come, and silence of the device."""

from __future__ import annotations

from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.steering_types import Action
from needle_controller.protocol.step_watch import REST_INSERTION
from needle_core.component import Log


class Patience:
    """Measures waits on the steady clock; `steady` is everywhere its reading [s].

    Attributes
    ----------
    silence : str
        What of the device has not been heard for long; empty when all is well.
    """

    def __init__(self) -> None:
        self.silence = ""
        self._since: float | None = None
        self._heard_since: float | None = None
        self._looked_at: JointSample | None = None

    def restart(self) -> None:
        """Begin to wait anew."""
        self._since = self._heard_since = None

    def hear(self) -> list[Action]:
        """Take that the device is heard; say so where that ends a silence."""
        self._heard_since = None
        was_silent, self.silence = bool(self.silence), ""
        return [Log("info", "the device is heard again")] if was_silent else []

    def waited(self, steady: float, *, moving: bool) -> float:
        """Return for how long something is awaited, not counting while it moves [s]."""
        if self._since is None or moving:
            self._since = steady
        return steady - self._since

    def notice_silence(self, steady: float, timeout: float) -> list[Action]:
        """Say, once, that the device has not been heard for so long [s].

        Nothing else follows: a simulation that a person pauses is as silent as a dead driver.
        """
        if self._heard_since is None:
            self._heard_since = steady
        if self.silence or steady - self._heard_since < timeout:
            return []
        self.silence = f"nothing heard of the device for {timeout:g} s, a step under way"
        return [Log("warning", self.silence)]

    def has_moved(self, latest: JointSample | None) -> bool:
        """Return whether the joints have moved since the last look."""
        before, self._looked_at = self._looked_at, latest
        return (
            latest is not None
            and before is not None
            and abs(latest.insertion - before.insertion) > REST_INSERTION
        )
