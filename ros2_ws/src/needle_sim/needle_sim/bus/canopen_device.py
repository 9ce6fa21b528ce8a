"""CANopen device (CiA 301): NMT states, heartbeats both ways, SDO, PDOs and emergencies."""

from __future__ import annotations

import abc
import enum
from functools import partial

from needle_core.can_frame import CanFrame
from needle_sim.bus.object_dictionary import Kind, ObjectDictionary, SdoServer, one_of
from needle_sim.bus.process_data import ReceivePdo, TransmitPdo

NMT = 0x000
SYNC = 0x080
EMERGENCY = 0x080
SDO_ANSWER = 0x580
SDO_REQUEST = 0x600
HEARTBEAT = 0x700
_PDOS = 4
_HEARTBEAT_CONSUMERS = 2
HEARTBEAT_LOST = 0x8130
_COMMUNICATION_ERROR = 0x10
_GENERIC_ERROR = 0x01
# 0x1029: whether a lost heartbeat ends OPERATIONAL.
_LEAVE_OPERATIONAL, _KEEP_STATE = 0, 1


class NetworkState(enum.IntEnum):
    """NMT states, with the codes of heartbeats."""

    BOOTING = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


class CanopenDevice(abc.ABC):
    """Generic CANopen device; a subclass adds the profile.

    Sent frames are collected in `outbox`. All times are readings of one steady clock [s].

    Parameters
    ----------
    node_id : int
        Node id, 1..127.
    dictionary : ObjectDictionary
        Objects from 0x2000 up; the device adds the communication objects.
    default_receive, default_transmit : tuple of int
        Mapping of the first PDO of each direction after power-up.
    boot_time : float
        Time from power-up to the boot-up message [s].
    """

    def __init__(
        self,
        node_id: int,
        dictionary: ObjectDictionary,
        *,
        default_receive: tuple[int, ...],
        default_transmit: tuple[int, ...],
        boot_time: float,
    ) -> None:
        self.node_id = node_id
        self._objects = dictionary
        self.outbox: list[CanFrame] = []
        self.network_state = NetworkState.BOOTING
        self._boot_time = boot_time
        self._boots_at = 0.0
        self._heartbeat_at = 0.0
        self._last_heartbeats: dict[int, float] = {}
        self._sdo = SdoServer(dictionary)
        self._add_communication_objects()
        numbers = range(_PDOS)
        self._receive = [ReceivePdo(dictionary, k, node_id, default_receive) for k in numbers]
        self._transmit = [TransmitPdo(dictionary, k, node_id, default_transmit) for k in numbers]

    @abc.abstractmethod
    def on_boot(self) -> None:
        """Handle the boot-up message."""

    @abc.abstractmethod
    def on_connection_lost(self) -> None:
        """Handle the loss of a monitored heartbeat, or a stop by NMT."""

    def power_up(self, now: float) -> None:
        """Power up: all written values return to their defaults."""
        self._objects.power_up()
        self.network_state = NetworkState.BOOTING
        self._boots_at = now + self._boot_time
        self._last_heartbeats.clear()
        self._reset_pdos()

    def receive(self, frame: CanFrame, now: float) -> None:
        """Handle a frame other than SYNC."""
        # Like many drives, this one does not support remote frames.
        if self.network_state is NetworkState.BOOTING or frame.remote:
            return
        identifier = frame.identifier
        if identifier == NMT:
            self._handle_nmt(frame.data, now)
        elif identifier == SDO_REQUEST + self.node_id:
            self._answer(frame)
        elif identifier > HEARTBEAT and identifier & 0x7F != self.node_id:
            if identifier & ~0x7F == HEARTBEAT:
                self._last_heartbeats[identifier & 0x7F] = now
        elif self.network_state is NetworkState.OPERATIONAL:
            for pdo in self._receive:
                if pdo.cob_id == identifier:
                    pdo.receive(frame.data)

    def sync(self) -> None:
        """Handle a SYNC: send the synchronous PDOs, then apply the received ones."""
        if self.network_state is not NetworkState.OPERATIONAL:
            return
        for transmit in self._transmit:
            self._send_pdo(transmit, transmit.sync())
        for receive in self._receive:
            receive.sync()

    def tick(self, now: float) -> None:
        """Handle timers: booting, heartbeats, watchdogs, event timers."""
        if self.network_state is NetworkState.BOOTING:
            if now >= self._boots_at:
                self.network_state = NetworkState.PRE_OPERATIONAL
                self._send(HEARTBEAT, bytes([NetworkState.BOOTING]))
                self._heartbeat_at = now
                self.on_boot()
            return
        period = self._objects.value(0x1017) * 1e-3
        if period > 0.0 and now - self._heartbeat_at >= period:
            # If the process was suspended, missed heartbeats are not sent later.
            self._heartbeat_at = max(self._heartbeat_at + period, now - period)
            self._send(HEARTBEAT, bytes([self.network_state]))
        self._check_heartbeats(now)
        if self.network_state is NetworkState.OPERATIONAL:
            for pdo in self._transmit:
                self._send_pdo(pdo, pdo.event())

    def emergency(self, code: int, register: int = 0) -> None:
        """Send an emergency; code 0 means that no error remains."""
        if code:
            register |= _GENERIC_ERROR
        self._objects.set(0x1001, 0, register)
        if self.network_state is not NetworkState.BOOTING:
            self._send(EMERGENCY, code.to_bytes(2, "little") + bytes([register]) + bytes(5))

    def _add_communication_objects(self) -> None:
        add = self._objects.add
        writable = partial(add, writable=True)
        add(0x1001, 0, Kind.U8, mappable=True)
        writable(0x1005, 0, Kind.U32, SYNC)
        writable(0x1006, 0, Kind.U32, 0)
        add(0x1014, 0, Kind.U32, EMERGENCY + self.node_id)
        add(0x1016, 0, Kind.U8, _HEARTBEAT_CONSUMERS)
        for k in range(1, _HEARTBEAT_CONSUMERS + 1):
            writable(0x1016, k, Kind.U32, 0)
            # Monitoring starts with the first heartbeat after the configuration.
            self._objects.entry(0x1016, k).on_written = self._restart_monitoring
        writable(0x1017, 0, Kind.U16, 0)
        add(0x1029, 0, Kind.U8, 1)
        choices = one_of((_LEAVE_OPERATIONAL, _KEEP_STATE))
        writable(0x1029, 1, Kind.U8, _LEAVE_OPERATIONAL, check=choices)

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
            self._set_network_state(states[command])
            if command == 0x02:
                self.on_connection_lost()
        elif command in (0x81, 0x82):
            self.power_up(now)

    def _set_network_state(self, state: NetworkState) -> None:
        if state is not self.network_state:
            self.network_state = state
            self._reset_pdos()

    def _reset_pdos(self) -> None:
        for receive in self._receive:
            receive.reset()
        for transmit in self._transmit:
            transmit.reset()

    def _answer(self, frame: CanFrame) -> None:
        if self.network_state is NetworkState.STOPPED:
            return
        answer = self._sdo.answer(frame.data)
        if answer is not None:
            self._send(SDO_ANSWER, answer)

    def _check_heartbeats(self, now: float) -> None:
        for k in range(1, _HEARTBEAT_CONSUMERS + 1):
            consumer = self._objects.value(0x1016, k)
            if not consumer:
                continue
            node, limit = consumer >> 16 & 0x7F, (consumer & 0xFFFF) * 1e-3
            # Monitoring begins with the first heartbeat.
            last = self._last_heartbeats.get(node)
            if limit == 0.0 or last is None or now - last <= limit:
                continue
            del self._last_heartbeats[node]
            self.emergency(HEARTBEAT_LOST, _COMMUNICATION_ERROR)
            self.on_connection_lost()
            keeps_state = self._objects.value(0x1029, 1) == _KEEP_STATE
            if self.network_state is NetworkState.OPERATIONAL and not keeps_state:
                self._set_network_state(NetworkState.PRE_OPERATIONAL)

    def _send_pdo(self, pdo: TransmitPdo, data: bytes | None) -> None:
        if data is not None and pdo.cob_id is not None:
            self.outbox.append(CanFrame(pdo.cob_id, data))

    def _send(self, function: int, data: bytes) -> None:
        self.outbox.append(CanFrame(function + self.node_id, data))
