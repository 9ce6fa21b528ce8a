"""Settings of one CiA 402 drive, and the units of its speeds and ramps (CiA 402-3, CiA 303-2)."""

from __future__ import annotations

import dataclasses

from needle_core.errors import UserError
from needle_device_driver.axes.axis_settings import PRESENT_POSITION_METHODS, AxisSettings
from needle_device_driver.axes.link import DriveError
from needle_device_driver.link import objects as od
from needle_device_driver.link.object_access import ObjectAccess, ObjectError
from needle_device_driver.procedure import Procedure

# Homing methods that use an index pulse; the others to a switch are 17 to 30.
INDEX_PULSE = (*range(1, 15), 33, 34)
HOMING_METHODS = (*INDEX_PULSE, *range(17, 31), *PRESENT_POSITION_METHODS)


@dataclasses.dataclass(frozen=True, kw_only=True)
class DriveSettings(AxisSettings):
    """Settings of an axis' drive.

    Attributes
    ----------
    node_id : int
        CANopen node id, 1..126.
    following_error_time : float
        Time for which the drive tolerates a greater following error [s].
    max_torque : float
        Largest share of the rated torque; 0: the drive's own setting.
    counts_per_turn : float
        Position counts per turn of the drive's shaft; 0: as the drive reports, or unknown.
    speed_unit, ramp_unit : float
        The drive's unit of speed [counts/s] and of ramps [counts/s^2].
    """

    node_id: int
    following_error_time: float
    max_torque: float
    counts_per_turn: float = 0.0
    speed_unit: float = 1.0
    ramp_unit: float = 1.0

    def __post_init__(self) -> None:
        """Check the homing method.

        Raises
        ------
        UserError
            If the homing method is unknown.
        """
        if self.homing_method not in HOMING_METHODS:
            raise UserError(f"homing_method = {self.homing_method} is not a CiA 402 method")

    @property
    def outer_switches(self) -> int:
        """Bits of the digital inputs that end an outward motion."""
        # If the drive counts in reverse, outward is its positive direction.
        limit = od.POSITIVE_LIMIT_SWITCH if self.reverse else od.NEGATIVE_LIMIT_SWITCH
        return limit | od.HOME_SWITCH

    @property
    def inner_switch(self) -> int:
        """Bit of the digital inputs that ends an inward motion."""
        return od.NEGATIVE_LIMIT_SWITCH if self.reverse else od.POSITIVE_LIMIT_SWITCH


# Codes of numerators and denominators. A dimensionless quantity is in counts.
_NUMERATORS = {0x00: "counts", 0x01: "m", 0x10: "rad", 0x41: "deg", 0xB4: "turns", 0xB5: "counts"}
_DENOMINATORS = {0x00: "", 0x03: "/s", 0x47: "/min", 0x57: "/s^2"}
_TURN_UNITS = {(0xB4, 0x47): "rpm", (0xC0, 0x03): "rpm/s"}
# Quantity of each object, and the accepted units.
_ACCEPTED = {
    od.POSITION_UNIT: ("positions", "counts"),
    od.SPEED_UNIT: ("speeds", "counts/s", "rpm"),
    od.RAMP_UNIT: ("ramps", "counts/s^2", "rpm/s"),
}


def read_units(
    access: ObjectAccess, settings: DriveSettings
) -> Procedure[tuple[DriveSettings, str]]:
    """Return the settings of a drive with its units, from 0x60A9 and 0x60AA.

    Parameters
    ----------
    access : ObjectAccess
        The drive.
    settings : DriveSettings
        Settings of the drive; a `counts_per_turn` above 0 replaces 0x608F and 0x6091.

    Returns
    -------
    DriveSettings
        Settings with units of counts/s or rpm, with any prefix; by default counts/s.
    str
        Units that the drive does not report, and the assumed ones; empty: none.

    Raises
    ------
    DriveError
        If positions are not in counts, the unit of speeds or ramps is not supported, or the counts
        per turn are missing or inconsistent.
    LinkError
        If the link is lost.
    """
    yield from _counts_in(access, settings, od.POSITION_UNIT)
    if not settings.actuated:
        return settings, ""
    speed = yield from _counts_in(access, settings, od.SPEED_UNIT)
    ramp = yield from _counts_in(access, settings, od.RAMP_UNIT)
    factor = (yield from _ratio(access, od.SPEED_FACTOR)) if speed is None else None
    if factor not in (None, 1.0):
        raise DriveError(f"the drive scales speeds by {factor:g} (0x6096), expected counts/s")
    ramps = "counts/s^2" if speed is None else "the unit of its speeds per second"
    assumptions = ["counts/s (0x60A9)"] * (speed is None) + [f"{ramps} (0x60AA)"] * (ramp is None)
    assumed = (
        f"does not report its units; assumed: {', '.join(assumptions)}; "
        "home it without a needle first (docs/hardware.md)"
    )
    speed = speed or 1.0
    # The counts per turn are only needed to bound a homing to an index pulse.
    turn = 0.0
    if settings.homing_method in INDEX_PULSE:
        turn = yield from _counts_per_turn(access, settings)
    settings = dataclasses.replace(
        settings, counts_per_turn=turn, speed_unit=speed, ramp_unit=ramp or speed
    )
    return settings, assumed if assumptions else ""


def _counts_in(
    access: ObjectAccess, settings: DriveSettings, entry: od.Entry
) -> Procedure[float | None]:
    """Return a unit of speed [counts/s] or ramps [counts/s^2]; None: not reported."""
    code = yield from access.read_optional(entry)
    if not code:
        return None
    # The upper byte is a power of ten, signed.
    power, above, below = (code >> 24 ^ 0x80) - 0x80, code >> 16 & 0xFF, code >> 8 & 0xFF
    unit = _TURN_UNITS.get((above, below)) or (
        _NUMERATORS.get(above, f"unit 0x{above:02X}")
        + _DENOMINATORS.get(below, f" per unit 0x{below:02X}")
    )
    what, *accepted = _ACCEPTED[entry]
    turns = unit in _TURN_UNITS.values()
    turn = (yield from _counts_per_turn(access, settings)) if turns else 60.0
    accepted = accepted[: 1 + bool(turn)]
    if unit not in accepted or (power and entry is od.POSITION_UNIT):
        scale = f"10^{power} " if power else ""
        unit_text = f"{scale}{unit} (0x{entry.index:04X} = 0x{code:08X})"
        hint = "; *_counts_per_turn converts rpm without 0x608F" if turns else ""
        raise ObjectError(
            f"the drive measures {what} in {unit_text}, expected {' or '.join(accepted)}{hint}",
            entry,
        )
    feed = None
    if turns and not settings.counts_per_turn:
        feed = yield from _ratio(access, od.FEED_CONSTANT)
    if feed and round(feed / turn, 6) != 1.0:
        both = f"{turn:g} (0x608F, 0x6091) and {feed:g} (0x6092)"
        raise DriveError(f"the drive reports {both} counts per turn: set *_counts_per_turn")
    return 10.0**power * turn / 60.0


def _counts_per_turn(access: ObjectAccess, settings: DriveSettings) -> Procedure[float]:
    """Return the counts per turn of the drive's shaft; 0: unknown."""
    if settings.counts_per_turn:
        return settings.counts_per_turn
    resolution = yield from _ratio(access, od.ENCODER_RESOLUTION)
    gear = yield from _ratio(access, od.GEAR_RATIO)
    return (resolution or 0.0) * (gear or 1.0)


def _ratio(access: ObjectAccess, entries: tuple[od.Entry, od.Entry]) -> Procedure[float | None]:
    above = yield from access.read_optional(entries[0])
    below = yield from access.read_optional(entries[1])
    return above / below if above and below else None
