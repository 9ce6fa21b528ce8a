"""A scripted CiA 402 drive."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator


class ScriptedDrive:
    """One CiA 402 drive as a script of the answer to each frame, written from the standard.

    It moves ideally: at each SYNC it reports its position, then it is at its set-point.
    """

    STATES = {
        "disabled": 0x0250,
        "ready": 0x0231,
        "on": 0x0233,
        "enabled": 0x0237,
        "quick stop": 0x0217,
        "fault": 0x0218,
    }

    def __init__(self, node: int) -> None:
        self.node = node
        self.objects: dict[tuple[int, int], bytes] = {
            (0x1000, 0): (402).to_bytes(4, "little"),
            (0x6502, 0): (0x000000A1).to_bytes(4, "little"),
            (0x603F, 0): b"\x00\x00",
            # Counts, counts/s, counts/s^2.
            (0x60A8, 0): bytes.fromhex("0000b500"),
            (0x60A9, 0): bytes.fromhex("0003b500"),
            (0x60AA, 0): bytes.fromhex("0057b500"),
        }
        for number in range(4):
            # Defaults: two PDOs are on, the first sent on change; no remote frames.
            off = 0x80000000 * (number > 1)
            for index, cob_id in ((0x1400, 0x200), (0x1800, 0x40000180)):
                value = off + cob_id + 0x100 * number + node
                self.objects[index + number, 1] = value.to_bytes(4, "little")
        self.missing_objects: set[int] = set()
        # Abort code of a write, or 0; stored value of a write.
        self.refuses: Callable[[int, int, bytes], int] = lambda index, sub, value: 0
        self.stores: Callable[[int, bytes], bytes] = lambda index, value: value
        self.ignores_sdo_orders = False
        # Whether it answers a SYNC with samples of the previous one.
        self.answers_previous_sample = False
        self.previous: list[tuple[int, bytes]] = []
        # Number of computer heartbeats before an answer; number of lost answers.
        self.answers_late = 0
        self.loses = 0
        self.held_back: list[tuple[int, list[tuple[int, bytes]]]] = []
        self.state = "disabled"
        self.mode = 0
        # Modes that it accepts by SDO.
        self.modes = {6, 8}
        # Orders that the drive ignores; whether it answers to SYNC, and has heartbeats; counts that
        # it moves at each SYNC without an order, in a state and while it homes.
        self.ignored_orders: set[str] = set()
        self.syncs = self.beats = True
        self.drift: dict[str, int] = {}
        self.search: Iterator[int] = iter(())
        self.inputs = 0
        self.position = 0
        self.target = 0
        self.next_target = 0
        self.demand = 0
        self.more_status = 0
        self.nmt = 0x7F
        self.silent = False
        self.blocked = False
        self.left_over = 0
        self.home_after = 3
        self.homing_for = -1
        self.last_word = 0
        self.stale_homing = False
        self.out: list[tuple[int, bytes]] = []

    def set_objects(self, values: dict[tuple[int, int], int]) -> None:
        """Set values of objects."""
        self.objects |= {at: value.to_bytes(4, "little") for at, value in values.items()}

    def value(self, index: int, sub: int = 0) -> int:
        """Return the value of an object."""
        return int.from_bytes(self.objects[index, sub], "little", signed=index == 0x607D)

    def emit(self, function: int, data: bytes) -> None:
        if not self.silent and (self.beats or function != 0x700):
            self.out.append((function + self.node, data))

    def reboot(self) -> None:
        self.nmt, self.state, self.position, self.mode = 0x7F, "disabled", 0, 0
        self.emit(0x700, b"\x00")

    def fail(self, code: int) -> None:
        self.state = "fault"
        self.objects[0x603F, 0] = code.to_bytes(2, "little")
        self.emit(0x80, code.to_bytes(2, "little") + bytes(6))

    @property
    def statusword(self) -> int:
        return self.STATES[self.state] | self.more_status

    def receive(self, cob_id: int, data: bytes) -> None:
        if cob_id == 0x600 + self.node:
            if self.nmt != 0x04:
                self.sdo(data)
        elif cob_id == 0 and data[1] == self.node:
            self.nmt = {0x01: 0x05, 0x80: 0x7F}[data[0]]
        elif cob_id == 0x77F:
            self.emit(0x700, bytes([self.nmt]))
            self.held_back = [(count - 1, frames) for count, frames in self.held_back]
            self.answer()
        elif self.nmt != 0x05:
            return
        elif cob_id == 0x200 + self.node:
            self.command(int.from_bytes(data[:2], "little"))
            self.mode = data[2]
        elif cob_id == 0x300 + self.node:
            self.next_target = int.from_bytes(data, "little", signed=True)
        elif cob_id == 0x80:
            self.sync()

    def sync(self) -> None:
        if not self.syncs:
            return
        status = self.statusword.to_bytes(2, "little") + bytes([self.mode])
        status += self.inputs.to_bytes(4, "little")
        place = self.position.to_bytes(4, "little", signed=True)
        place += (self.demand - self.position).to_bytes(4, "little", signed=True)
        # Lengths as mapped.
        status = status if self.objects[0x1A00, 0] == b"\x03" else status[:3]
        place = place if self.objects[0x1A01, 0] == b"\x02" else place[:4]
        now = [(0x180, status), (0x280, place)]
        if self.loses:
            self.loses -= 1
        else:
            self.held_back.append(
                (self.answers_late, self.previous if self.answers_previous_sample else now)
            )
        self.answer()
        self.previous = now
        self.target = self.next_target
        if self.homing_for >= 0:
            self.homing_for += 1
            if self.homing_for >= self.home_after:
                self.homing_for = -1
                self.position = 0
                self.more_status = 0x1400
            elif self.state == "enabled":
                self.position += next(self.search, 0)
        else:
            self.follow()
        if self.state in self.drift:
            self.position += self.drift[self.state]
            self.demand = self.position

    def searches(self, *ways: int, forever: int = 0) -> None:
        """Move by these counts per cycle while it homes, and find no home."""
        self.home_after = 10**9
        self.search = itertools.chain(ways, itertools.repeat(forever))

    def answer(self) -> None:
        """Send the answers that are due."""
        while self.held_back and self.held_back[0][0] <= 0:
            for function, data in self.held_back.pop(0)[1]:
                self.emit(function, data)

    def follow(self) -> None:
        """Move to the demand, with power, also in a quick stop."""
        if self.state == "enabled" and self.mode == 8:
            self.demand = self.target - self.left_over
        elif self.state != "quick stop":
            self.demand = self.position
        if not self.blocked:
            self.position = self.demand

    def command(self, word: int) -> None:
        order = "quick stop" if word & 0x06 == 0x02 else "" if word & 0x02 else "off"
        if order in self.ignored_orders:
            return
        if self.state == "fault":
            if word & 0x80 and not self.last_word & 0x80 and "reset" not in self.ignored_orders:
                self.state = "disabled"
        elif not word & 0x02:
            self.state = "disabled"
        elif not word & 0x04:
            self.state = "quick stop" if self.state in ("enabled", "quick stop") else "disabled"
        elif word & 0x0F == 0x06 and self.state in ("disabled", "on", "enabled"):
            self.state = "ready"
        elif word & 0x0F == 0x07 and self.state in ("ready", "enabled"):
            self.state = "on"
        elif word & 0x0F == 0x0F and self.state in ("on", "quick stop"):
            self.state = "enabled"
        rising = word & 0x10 and not self.last_word & 0x10
        self.last_word = word
        if rising and self.mode == 6 and self.state == "enabled":
            self.homing_for = 0
            if not self.stale_homing:
                self.more_status = 0
        if self.mode != 6:
            self.homing_for = -1
            self.more_status = 0x1400 if self.stale_homing else 0

    def sdo(self, data: bytes) -> None:
        if data[0] == 0x80:
            return
        index, sub, head = int.from_bytes(data[1:3], "little"), data[3], data[1:4]
        written = b"" if data[0] == 0x40 else data[4 : 8 - (data[0] >> 2 & 3)]
        live = {
            (0x6041, 0): self.statusword.to_bytes(2, "little"),
            (0x6061, 0): bytes([self.mode]),
            (0x6064, 0): self.position.to_bytes(4, "little", signed=True),
            (0x60F4, 0): (self.demand - self.position).to_bytes(4, "little", signed=True),
            (0x60FD, 0): self.inputs.to_bytes(4, "little"),
        }
        value = written or live.get((index, sub)) or self.objects.get((index, sub))
        code = self.refuses(index, sub, written) if written else 0
        if index in self.missing_objects or value is None:
            code = 0x0602_0000
        if code:
            self.emit(0x580, b"\x80" + head + code.to_bytes(4, "little"))
            return
        assert value is not None
        if not written:
            first = 0x43 | (4 - len(value)) << 2
            self.emit(0x580, bytes([first]) + head + value.ljust(4, b"\x00"))
            return
        self.objects[index, sub] = self.stores(index, written)
        if index == 0x6040 and not (self.ignores_sdo_orders and self.nmt == 0x05):
            self.command(int.from_bytes(written, "little"))
        if index == 0x6060 and written[0] in self.modes:
            self.mode = written[0]
        self.emit(0x580, b"\x60" + head + bytes(4))
