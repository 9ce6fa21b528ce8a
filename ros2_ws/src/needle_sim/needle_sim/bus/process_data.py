"""PDOs of a CANopen device (CiA 301): communication parameters, mapping and triggers."""

from __future__ import annotations

import contextlib
from functools import partial

from needle_sim.bus.object_dictionary import Abort, Kind, ObjectDictionary, SdoAbortError, one_of

_INVALID = 1 << 31
_MOST_ENTRIES = 8
# Transmission types: with every SYNC, or at once (of the manufacturer or the device profile).
_EVERY_SYNC = 1
_AT_ONCE = (254, 255)


class _Pdo:
    """PDO of either direction: COB-ID, transmission type, mapping.

    Parameters
    ----------
    dictionary : ObjectDictionary
        Object dictionary of the device, which holds the parameters.
    number : int
        Number within its direction, from 0.
    node_id : int
        Node id of the device. Identifiers are those of the predefined connection set; after
        power-up, only the first PDO is enabled.
    default : tuple of int
        Mapping of the first PDO after power-up: index << 16 | subindex << 8 | bits.
    """

    # For each direction: identifier of the first PDO, indices of its communication and mapping
    # parameters, and further sub-indices of the former, which only accept 0.
    _first_cob_id: int
    _first_parameters: int
    _first_mapping: int
    _unused_parameters: tuple[int, ...] = ()

    def __init__(
        self, dictionary: ObjectDictionary, number: int, node_id: int, default: tuple[int, ...]
    ) -> None:
        self._dictionary = dictionary
        self._parameters = parameters = self._first_parameters + number
        self._mapping = mapping = self._first_mapping + number
        cob_id = self._first_cob_id + 0x100 * number + node_id | (_INVALID if number else 0)
        mapped = () if number else default
        writable = partial(dictionary.add, writable=True)
        dictionary.add(parameters, 0, Kind.U8, max((2, *self._unused_parameters)))
        writable(parameters, 1, Kind.U32, cob_id, check=self._check_cob_id)
        types = one_of((_EVERY_SYNC, *_AT_ONCE))
        writable(parameters, 2, Kind.U8, _AT_ONCE[-1], check=types)
        for subindex in self._unused_parameters:
            writable(parameters, subindex, Kind.U16, 0, check=one_of((0,)))
        writable(mapping, 0, Kind.U8, len(mapped), check=self._check_count)
        for entry in range(1, _MOST_ENTRIES + 1):
            value = mapped[entry - 1] if entry <= len(mapped) else 0
            writable(mapping, entry, Kind.U32, value, check=self._check_entry)
        # Cached, because they are read at every frame and every tick.
        self._mapping_entries = [dictionary.entry(mapping, k) for k in range(_MOST_ENTRIES + 1)]
        self._cob_id = dictionary.entry(parameters, 1)
        self._transmission_type = dictionary.entry(parameters, 2)

    @property
    def cob_id(self) -> int | None:
        """Identifier; None while the PDO is disabled."""
        value = self._cob_id.value
        return None if value & _INVALID else value & 0x7FF

    @property
    def _is_synchronous(self) -> bool:
        return self._transmission_type.value == _EVERY_SYNC

    @property
    def mapped(self) -> list[tuple[int, int, int]]:
        """(index, subindex, bytes) of each mapped object."""
        count, *entries = self._mapping_entries
        values = (entry.value for entry in entries[: count.value])
        return [(v >> 16, v >> 8 & 0xFF, (v & 0xFF) // 8) for v in values]

    def _check_cob_id(self, value: int) -> None:
        changed = (value ^ self._dictionary.value(self._parameters, 1)) & 0x1FFFFFFF
        # The identifier may change only while the PDO is disabled.
        if changed and self.cob_id is not None and not value & _INVALID:
            raise SdoAbortError(Abort.VALUE_RANGE)
        if value & 0x1FFFF800:
            raise SdoAbortError(Abort.VALUE_RANGE)

    def _check_disabled(self) -> None:
        if self.cob_id is not None:
            raise SdoAbortError(Abort.DEVICE_STATE)

    def _check_entry(self, value: int) -> None:
        self._check_disabled()
        if self._dictionary.value(self._mapping, 0) != 0:
            raise SdoAbortError(Abort.DEVICE_STATE)
        if value:
            self._size(value)

    def _check_count(self, count: int) -> None:
        self._check_disabled()
        if count > _MOST_ENTRIES:
            raise SdoAbortError(Abort.VALUE_RANGE)
        values = [self._dictionary.value(self._mapping, k) for k in range(1, count + 1)]
        if sum(self._size(value) for value in values) > 8:
            raise SdoAbortError(Abort.MAPPING_TOO_LONG)

    def _size(self, value: int) -> int:
        entry = self._dictionary.entry(value >> 16, value >> 8 & 0xFF)
        if entry.kind is None or not entry.mappable or value & 0xFF != 8 * entry.kind.size:
            raise SdoAbortError(Abort.NOT_MAPPABLE)
        return entry.kind.size


class ReceivePdo(_Pdo):
    """Receives values from the bus; the parameters are those of `_Pdo`."""

    _first_cob_id, _first_parameters, _first_mapping = 0x200, 0x1400, 0x1600
    _waiting: bytes | None = None

    def receive(self, data: bytes) -> None:
        """Apply the data of a frame, now or with the next SYNC."""
        if self._is_synchronous:
            self._waiting = data
        else:
            self._apply(data)

    def sync(self) -> None:
        """Apply the data that waits for a SYNC."""
        if self._waiting is not None:
            data, self._waiting = self._waiting, None
            self._apply(data)

    def reset(self) -> None:
        """Drop the data that waits for a SYNC."""
        self._waiting = None

    def _apply(self, data: bytes) -> None:
        mapped = self.mapped
        # A shorter frame must not be applied in part.
        if sum(size for _, _, size in mapped) > len(data):
            return
        begin = 0
        for index, subindex, size in mapped:
            # A PDO has no answer, so an invalid value is just ignored.
            with contextlib.suppress(SdoAbortError):
                self._dictionary.write(index, subindex, data[begin : begin + size])
            begin += size


class TransmitPdo(_Pdo):
    """Sends values to the bus, with every SYNC or on change; the parameters are those of `_Pdo`."""

    _first_cob_id, _first_parameters, _first_mapping = 0x180, 0x1800, 0x1A00
    # Inhibit time and event timer.
    _unused_parameters = (3, 5)
    _sent: bytes | None = None

    def sync(self) -> bytes | None:
        """Return the data to send with a SYNC, if any."""
        return self._data() if self.cob_id is not None and self._is_synchronous else None

    def event(self) -> bytes | None:
        """Return the data to send because of a change, if any."""
        if self.cob_id is None or self._is_synchronous:
            return None
        data = self._data()
        if data == self._sent:
            return None
        self._sent = data
        return data

    def reset(self) -> None:
        """Discard the last sent data, so that the next event sends them again."""
        self._sent = None

    def _data(self) -> bytes:
        return b"".join(self._dictionary.read(index, sub) for index, sub, _ in self.mapped)
