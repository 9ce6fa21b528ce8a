"""Checks of emulated drives: their states, a whole step, and orders that bypass the driver."""

from __future__ import annotations

from collections.abc import Callable

from needle_device_driver.conformance.rig import DRIVER, ConformanceRig
from needle_device_driver.procedure import Procedure

STEP_TIME = 0.41
"""Duration of a step of 2 mm at nearly the largest speed [s]."""
TIGHT = 50e-6
"""Software limits on either side of home, for an order beyond them [m]."""
_OFF = ("OFF", "SWITCH_ON_DISABLED", "READY_TO_SWITCH_ON", "SWITCHED_ON")


def order_directly(make: Callable[..., ConformanceRig], *, stops: bool) -> float:
    """Order a long motion while the driver hangs; return the travel [m].

    The order is stopped at once, or goes beyond tight software limits. CiA 402 has no such order.
    """
    rig = make()
    protocol = rig.insertion_protocol
    if protocol is None:
        return 0.0
    write, settings, home = protocol.write_limits, protocol.axes["insertion"], dict[str, int]()
    near = settings.magnitude(TIGHT)

    def write_tight(axis: str, lower: int, upper: int) -> Procedure[None]:
        home[axis] = lower - protocol.axes[axis].limits_counts[0]
        limits = (lower, upper) if stops else (home[axis] - near, home[axis] + near)
        yield from write(axis, *limits)

    rig.start()
    protocol.write_limits = write_tight
    rig.ready()
    rig.runner.freeze(DRIVER, 0.5)
    begin = rig.positions[0]
    target = home["insertion"] + settings.direction * settings.magnitude(200.0 * TIGHT)
    protocol.move_to("insertion", target, settings.magnitude(settings.speed))
    if stops:
        protocol.stop("insertion")
    rig.emulator("insertion").receive(protocol.link.pop_outgoing(), rig.runner.now)
    # No watchdog acts earlier.
    rig.runner.run(0.07)
    return abs(rig.positions[0] - begin)


def check_step(rig: ConformanceRig) -> None:
    """Check that a step at nearly the largest speed ends at its target soon after its time."""
    stamp = rig.step(duration=STEP_TIME)
    rig.runner.run(2.0 * STEP_TIME)
    assert rig.hand.results.get(stamp) == "succeeded", (rig.hand.results, rig.logged)


def are_switched_off(rig: ConformanceRig, *others: str) -> bool:
    """Return whether the state of each emulated drive begins with one of `_OFF` or `others`."""
    states = [s for drives in rig.drives.connections.values() for s in drives.states().values()]
    return all(state.startswith((*_OFF, *others)) for state in states)
