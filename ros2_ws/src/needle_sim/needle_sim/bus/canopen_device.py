"""CANopen device (CiA 301): NMT states, heartbeats both ways, SDO, PDOs and emergencies."""

from __future__ import annotations

import enum
from collections.abc import Callable
from functools import partial

from needle_core.can_frame import CanFrame
from needle_sim.bus.object_dictionary import Kind, ObjectDictionary, SdoServer
from needle_sim.bus.process_data import INVALID, ReceivePdo, TransmitPdo

NMT = 0x000
SYNC = 0x080
EMERGENCY = 0x080
SDO_ANSWER = 0x580
SDO_REQUEST = 0x600
HEARTBEAT = 0x700
# COB-IDs of the predefined connection set.
_RECEIVE = (0x200, 0x300, 0x400, 0x500)
_TRANSMIT = (0x180, 0x280, 0x380, 0x480)
_HEARTBEAT_CONSUMERS = 2
_ERRORS_KEPT = 4
HEARTBEAT_LOST = 0x8130
_COMMUNICATION_ERROR = 0x10
_GENERIC_ERROR = 0x01
# 0x1029: reaction of the network state to a lost heartbeat.
_KEEP_STATE, _STOP = 1, 2


class NetworkState(enum.IntEnum):
    """NMT states, with the codes of heartbeats."""

    BOOTING = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


class CanopenDevice:
    """Generic CANopen device; its profile is in `dictionary` and the callbacks.

    Sent frames collect in `outbox`. All times are readings of one steady clock [s].

    Parameters
    ----------
    node_id : int
        1..127.
    dictionary : ObjectDictionary
        Objects from 0x2000 up; the device adds the communication objects.
    default_receive, default_transmit : tuple of int
        Mapping of the first PDO of each direction after power-up.
    boot_time : float
        From power-up to the boot-up message [s].
    on_power_up, on_boot : callable
        Called at power-up (also by an NMT reset), and at the boot-up message.
    on_connection_lost : callable
        Called when a monitored heartbeat is lost, or NMT stops the device.
    """

    def __init__(
        self,
        node_id: int,
        dictionary: ObjectDictionary,
        *,
        default_receive: tuple[int, ...],
        default_transmit: tuple[int, ...],
        boot_time: float,
        on_power_up: Callable[[], None],
        on_boot: Callable[[], None],
        on_connection_lost: Callable[[], None],
    ) -> None:
        self.node_id = node_id
        self.dictionary = dictionary
        self.outbox: list[CanFrame] = []
        self.state = NetworkState.BOOTING
        self._boot_time = boot_time
        self._on_power_up = on_power_up
        self._on_boot = on_boot
        self._on_connection_lost = on_connection_lost
        self._boots_at = 0.0
        self._heartbeat_at = 0.0
        self._last_heartbeats: dict[int, float] = {}
        self._errors: list[int] = []
        self._sdo = SdoServer(dictionary)
        self._add_communication_objects()

        def cob_ids(codes: tuple[int, ...]) -> list[int]:
            """Return the identifiers after power-up, when only the first PDO is enabled."""
            return [code + node_id | (INVALID if k else 0) for k, code in enumerate(codes)]

        self._receive = [
            ReceivePdo(dictionary, k, cob_id, () if k else default_receive)
            for k, cob_id in enumerate(cob_ids(_RECEIVE))
        ]
        self._transmit = [
            TransmitPdo(dictionary, k, cob_id, () if k else default_transmit)
            for k, cob_id in enumerate(cob_ids(_TRANSMIT))
        ]

    def power_up(self, now: float) -> None:
        """Power up: all written values return to their defaults."""
        self.dictionary.power_up()
        self.state = NetworkState.BOOTING
        self._boots_at = now + self._boot_time
        self._last_heartbeats.clear()
        self._errors.clear()
        self._reset_pdos()
        self._on_power_up()

    def is_read_request(self, frame: CanFrame) -> bool:
        """Return whether a frame requests the value of an object of this device."""
        return frame.identifier == SDO_REQUEST + self.node_id

    def receive(self, frame: CanFrame, now: float) -> bool:
        """Handle a frame other than SYNC; return whether it was for this device."""
        # Remote frames are not supported, like by many drives.
        if self.state is NetworkState.BOOTING or frame.remote:
            return False
        identifier = frame.identifier
        if identifier == NMT:
            self._handle_nmt(frame.data, now)
        elif identifier == SDO_REQUEST + self.node_id:
            self._answer(frame)
        elif identifier > HEARTBEAT and identifier & 0x7F != self.node_id:
            if identifier & ~0x7F == HEARTBEAT:
                self._last_heartbeats[identifier & 0x7F] = now
            return False
        else:
            return self.state is NetworkState.OPERATIONAL and self._handle_pdo(frame)
        return True

    def sync(self) -> None:
        """Handle a SYNC: send the synchronous PDOs, then apply the received ones."""
        if self.state is not NetworkState.OPERATIONAL:
            return
        for transmit in self._transmit:
            self._send_pdo(transmit, transmit.sync())
        for receive in self._receive:
            receive.sync()

    def tick(self, now: float) -> None:
        """Handle timers: booting, heartbeats, watchdogs, event timers."""
        if self.state is NetworkState.BOOTING:
            if now >= self._boots_at:
                self.state = NetworkState.PRE_OPERATIONAL
                self._send(HEARTBEAT, bytes([NetworkState.BOOTING]))
                self._heartbeat_at = now
                self._on_boot()
            return
        period = self.dictionary.value(0x1017) * 1e-3
        if period > 0.0 and now - self._heartbeat_at >= period:
            # If the process was suspended, missed heartbeats are not sent later.
            self._heartbeat_at = max(self._heartbeat_at + period, now - period)
            self._send(HEARTBEAT, bytes([self.state]))
        self._check_heartbeats(now)
        if self.state is NetworkState.OPERATIONAL:
            for pdo in self._transmit:
                self._send_pdo(pdo, pdo.event(now))

    def emergency(self, code: int, register: int = 0) -> None:
        """Send an emergency; code 0 means that no error is left."""
        if code:
            self._errors = [code, *self._errors][:_ERRORS_KEPT]
            register |= _GENERIC_ERROR
        self.dictionary.set(0x1001, 0, register)
        self.dictionary.set(0x1003, 0, len(self._errors))
        for k, error in enumerate(self._errors):
            self.dictionary.set(0x1003, k + 1, error)
        if self.state is not NetworkState.BOOTING:
            self._send(EMERGENCY, code.to_bytes(2, "little") + bytes([register]) + bytes(5))

    def _add_communication_objects(self) -> None:
        add = self.dictionary.add
        writable = partial(add, writable=True)
        add(0x1001, 0, Kind.U8, mappable=True)
        writable(0x1003, 0, Kind.U8)
        for k in range(1, _ERRORS_KEPT + 1):
            add(0x1003, k, Kind.U32)
        writable(0x1005, 0, Kind.U32, SYNC)
        writable(0x1006, 0, Kind.U32, 0)
        add(0x1014, 0, Kind.U32, EMERGENCY + self.node_id)
        add(0x1016, 0, Kind.U8, _HEARTBEAT_CONSUMERS)
        for k in range(1, _HEARTBEAT_CONSUMERS + 1):
            writable(0x1016, k, Kind.U32, 0)
            # Monitoring starts with the first heartbeat after the configuration.
            self.dictionary.on_write(0x1016, k, then=self._restart_monitoring)
        writable(0x1017, 0, Kind.U16, 0)
        add(0x1029, 0, Kind.U8, 1)
        writable(0x1029, 1, Kind.U8, 0)
        self.dictionary.on_write(0x1003, 0, then=lambda _: self._errors.clear())

    def _handle_pdo(self, frame: CanFrame) -> bool:
        matching = [pdo for pdo in self._receive if pdo.cob_id == frame.identifier]
        for pdo in matching:
            pdo.receive(frame.data)
        return bool(matching)

    def _restart_monitoring(self, consumer: int) -> None:
        self._last_heartbeats.pop(consumer >> 16 & 0x7F, None)

    def _handle_nmt(self, data: bytes, now: float) -> None:
        if len(data) != 2 or data[1] not in (0, self.node_id):
            return
        command = data[0]
        states = {
            0x01: NetworkState.OPERATIONAL,
            0x02: NetworkState.STOPPED,
            0x80: NetworkState.PRE_OPERATIONAL,
        }
        if command in states:
            self._set_state(states[command])
            if command == 0x02:
                self._on_connection_lost()
        elif command in (0x81, 0x82):
            self.power_up(now)

    def _set_state(self, state: NetworkState) -> None:
        if state is not self.state:
            self.state = state
            self._reset_pdos()

    def _reset_pdos(self) -> None:
        for receive in self._receive:
            receive.reset()
        for transmit in self._transmit:
            transmit.reset()

    def _answer(self, frame: CanFrame) -> None:
        if self.state is NetworkState.STOPPED:
            return
        answer = self._sdo.answer(frame.data)
        if answer is not None:
            self._send(SDO_ANSWER, answer)

    def _check_heartbeats(self, now: float) -> None:
        for k in range(1, _HEARTBEAT_CONSUMERS + 1):
            consumer = self.dictionary.value(0x1016, k)
            if not consumer:
                continue
            node, limit = consumer >> 16 & 0x7F, (consumer & 0xFFFF) * 1e-3
            # Monitoring begins with the first heartbeat.
            last = self._last_heartbeats.get(node)
            if limit == 0.0 or last is None or now - last <= limit:
                continue
            del self._last_heartbeats[node]
            self.emergency(HEARTBEAT_LOST, _COMMUNICATION_ERROR)
            self._on_connection_lost()
            behaviour = self.dictionary.value(0x1029, 1)
            if behaviour == _STOP:
                self._set_state(NetworkState.STOPPED)
            elif behaviour != _KEEP_STATE and self.state is NetworkState.OPERATIONAL:
                self._set_state(NetworkState.PRE_OPERATIONAL)

    def _send_pdo(self, pdo: TransmitPdo, data: bytes | None) -> None:
        if data is not None and pdo.cob_id is not None:
            self.outbox.append(CanFrame(pdo.cob_id, data))

    def _send(self, function: int, data: bytes) -> None:
        self.outbox.append(CanFrame(function + self.node_id, data))
