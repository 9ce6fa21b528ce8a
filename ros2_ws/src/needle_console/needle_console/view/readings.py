"""Readings of a snapshot as text, in mm and degrees."""

from __future__ import annotations

import math

from needle_console.view.snapshot import Snapshot

NONE = "\N{EN DASH}"
_MM = 1e3


def readings(snapshot: Snapshot) -> dict[str, str]:
    """Return the readings as text by label; the labels are always the same.

    Parameters
    ----------
    snapshot : Snapshot
        State of the rig.
    """
    return {
        "Depth": _depth(snapshot),
        "Distance from plane": _off_plane(snapshot),
        "Rotation of the base": _turn(snapshot.rotation),
        "Tip": _tip(snapshot),
        "Reach": _reach(snapshot),
        "Estimate": _estimate(snapshot),
    }


def mm(value: float, digits: int = 2) -> str:
    """Return a length [m] as text in mm, with a true minus sign; a dash for NaN."""
    if math.isnan(value):
        return NONE
    return f"{value * _MM:.{digits}f} mm".replace("-", "\N{MINUS SIGN}")


def _depth(snapshot: Snapshot) -> str:
    at = mm(snapshot.insertion, 1)
    controller = snapshot.controller
    if controller is None or controller.depth_m is None:
        return at
    return f"{at} of {mm(controller.depth_m, 0)}"


def _off_plane(snapshot: Snapshot) -> str:
    if not snapshot.track:
        return NONE
    last, controller = snapshot.track[-1], snapshot.controller
    text = mm(last.r1)
    if controller is None or controller.r1_low_m is None or controller.r1_high_m is None:
        return text
    return f"{text} (95 %: {mm(controller.r1_low_m)[:-3]} to {mm(controller.r1_high_m)[:-3]})"


def _turn(rotation: float) -> str:
    if math.isnan(rotation):
        return NONE
    turns = rotation / (2.0 * math.pi)
    text = f"{math.degrees(rotation):.1f}\N{DEGREE SIGN} ({turns:.2f} turns)"
    return text.replace("-", "\N{MINUS SIGN}")


def _tip(snapshot: Snapshot) -> str:
    if snapshot.tip_lost_for > 0.0:
        return f"not found for {snapshot.tip_lost_for:.1f} s"
    if snapshot.tip is None:
        return NONE
    if snapshot.tip.age > 1.0:
        return f"no images for {snapshot.tip.age:.0f} s"
    x, y, z = (f"{c * _MM:.1f}".replace("-", "\N{MINUS SIGN}") for c in snapshot.tip.position)
    return f"{x}, {y}, {z} mm"


def _reach(snapshot: Snapshot) -> str:
    controller = snapshot.controller
    if controller is None or controller.reachable is None:
        return NONE
    what = "plane" if controller.target_point_m is None else "point"
    if not controller.reachable:
        return f"the {what} is out of reach"
    needs = controller.reachable_depth_m
    return f"the {what} can be reached" + ("" if needs is None else f", from {mm(needs, 0)} on")


def _estimate(snapshot: Snapshot) -> str:
    controller = snapshot.controller
    return (controller.trusted if controller is not None else "") or NONE
