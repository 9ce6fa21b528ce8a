"""PDOs of a CANopen device (CiA 301): communication parameters, mapping and triggers."""

from __future__ import annotations

import contextlib
from functools import partial

from needle_sim.bus.object_dictionary import (
    Abort,
    Kind,
    ObjectDictionary,
    SdoAbortError,
)

INVALID = 1 << 31
_MOST_ENTRIES = 8
_LAST_SYNCHRONOUS = 240
_EVENT_DRIVEN = 254


class _Pdo:
    """PDO of either direction: COB-ID, transmission type, mapping.

    Parameters
    ----------
    dictionary : ObjectDictionary
        Object dictionary of the device, which holds the parameters.
    number : int
        Number within its direction, from 0.
    cob_id : int
        Identifier after power-up; bit 31 disables the PDO.
    mapped : tuple of int
        Mapping after power-up: index << 16 | subindex << 8 | bits.
    """

    # For each direction: indices of the first communication and mapping parameters, and further
    # sub-indices of the former.
    _first_parameters: int
    _first_mapping: int
    _more_parameters: tuple[int, ...] = ()

    def __init__(
        self, dictionary: ObjectDictionary, number: int, cob_id: int, mapped: tuple[int, ...]
    ) -> None:
        self._dictionary = dictionary
        self._parameters = parameters = self._first_parameters + number
        self._mapping = mapping = self._first_mapping + number
        add = dictionary.add
        writable = partial(add, writable=True)
        add(parameters, 0, Kind.U8, max((2, *self._more_parameters)))
        writable(parameters, 1, Kind.U32, cob_id)
        writable(parameters, 2, Kind.U8, 255)
        for subindex in self._more_parameters:
            writable(parameters, subindex, Kind.U16, 0)
        writable(mapping, 0, Kind.U8, len(mapped))
        for entry in range(1, _MOST_ENTRIES + 1):
            value = mapped[entry - 1] if entry <= len(mapped) else 0
            writable(mapping, entry, Kind.U32, value)
            dictionary.on_write(mapping, entry, check=self._check_entry)
        dictionary.on_write(parameters, 1, check=self._check_cob_id)
        dictionary.on_write(mapping, 0, check=self._check_count)
        # Cached, because they are read at every frame and every tick.
        self._mapping_entries = [dictionary.entry(mapping, k) for k in range(_MOST_ENTRIES + 1)]
        self._mapped_by: tuple[int, list[int]] | None = None
        self._mapped: list[tuple[int, int, int]] = []
        self._cob_id = dictionary.entry(parameters, 1)
        self._transmission_type = dictionary.entry(parameters, 2)

    @property
    def cob_id(self) -> int | None:
        """Identifier; None while the PDO is disabled."""
        value = self._cob_id.value
        return None if value & INVALID else value & 0x7FF

    @property
    def transmission_type(self) -> int:
        """Transmission type: 0..240 with SYNC, 254 and 255 event-driven."""
        return self._transmission_type.value

    @property
    def mapped(self) -> list[tuple[int, int, int]]:
        """(index, subindex, bytes) of each mapped object."""
        count, *values = (entry.value for entry in self._mapping_entries)
        if (count, values) != self._mapped_by:
            self._mapped_by = count, values
            self._mapped = [(v >> 16, v >> 8 & 0xFF, (v & 0xFF) // 8) for v in values[:count]]
        return self._mapped

    def _check_cob_id(self, value: int) -> None:
        changed = (value ^ self._dictionary.value(self._parameters, 1)) & 0x1FFFFFFF
        # The identifier may change only while the PDO is disabled.
        if changed and self.cob_id is not None and not value & INVALID:
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

    _first_parameters, _first_mapping = 0x1400, 0x1600
    _waiting: bytes | None = None

    def receive(self, data: bytes) -> None:
        """Apply the data of a frame, now or with the next SYNC."""
        if self.transmission_type <= _LAST_SYNCHRONOUS:
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
    """Sends values to the bus: with every n-th SYNC, on change or by timer.

    The parameters are those of `_Pdo`.
    """

    _first_parameters, _first_mapping = 0x1800, 0x1A00
    # Inhibit time and event timer.
    _more_parameters = (3, 5)
    _syncs = 0
    _sent: bytes | None = None
    _sent_at = 0.0

    def data(self) -> bytes:
        """Return the present values."""
        return b"".join(self._dictionary.read(index, sub) for index, sub, _ in self.mapped)

    def sync(self) -> bytes | None:
        """Return the data to send with this SYNC, if any."""
        kind = self.transmission_type
        if self.cob_id is None or kind > _LAST_SYNCHRONOUS:
            return None
        data = self.data()
        if kind == 0:
            changed, self._sent = data != self._sent, data
            return data if changed else None
        self._syncs += 1
        if self._syncs < kind:
            return None
        self._syncs = 0
        return data

    def event(self, now: float) -> bytes | None:
        """Return the data to send because of a change or the event timer, if any; `now` in s."""
        if self._transmission_type.value < _EVENT_DRIVEN or self._cob_id.value & INVALID:
            return None
        data = self.data()
        age = now - self._sent_at
        inhibit = self._dictionary.value(self._parameters, 3) * 1e-4
        timer = self._dictionary.value(self._parameters, 5) * 1e-3
        due = (data != self._sent and age >= inhibit) or (timer > 0.0 and age >= timer)
        if not due:
            return None
        self._sent, self._sent_at = data, now
        return data

    def reset(self) -> None:
        """Forget the data sent last, so that the next event sends it again."""
        self._sent = None
        self._syncs = 0
