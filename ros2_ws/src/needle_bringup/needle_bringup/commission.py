"""`ros2 run needle_bringup commission`: measure the distance of each kind of stop on a bench."""

from __future__ import annotations

import datetime
import math
import select
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from needle_bags.recording.bag_tap import BagTap
from needle_bringup.operator.component import INPUT_DEVICE, Operator
from needle_bringup.operator.input_port import InputPort
from needle_bringup.operator.parameters import OperatorParameters
from needle_core.commands.cli import EXIT_DONE, EXIT_MISSED, run_command
from needle_core.commands.options import CommandParser, number
from needle_core.component import Call, Component, Publish
from needle_core.errors import UserError
from needle_core.messages import EmergencyStop
from needle_core.runners.paced import PacedRunner
from needle_core.runners.virtual import DIAGNOSTICS, LOG
from needle_core.settings.parameter_fields import from_values
from needle_core.settings.parameter_files import read_parameters
from needle_device_driver.axes.axis import PERIOD
from needle_device_driver.conformance.faults import FAULTS, Fault, can_satisfy, largest_travel
from needle_device_driver.conformance.rig import DRIVER, ConformanceRig, RigClient
from needle_device_driver.device import EMERGENCY_STOP
from needle_device_driver.device_driver import DeviceDriver
from needle_device_driver.parameters import read_driver_parameters

_DESCRIPTION = """\
Commission drives on a bench without a needle: home them, move 10 mm, and stop a fast step in each
possible way, partly by your hand; measure from joint_states how far the axes then move.

Stop device_driver first: this command runs the same driver, with the parameters of FILE. Its
section `operator` names the pedal: real drives move only while you hold it, emulated ones also
without. Keep a hand on the emergency stop. Writes a bag, and a report to be signed.
"""
_EPILOG = """\
example:
  ros2 run needle_bringup commission --params drives.yaml --out commissioning

exit codes: 0 all stops within their bounds; 1 some are not; 2 invalid input, or no drives; 130
interrupted
"""
_STEP, _STEP_TIME, _SETTLED = 0.002, 0.41, 1.5
_DISTANCE = 0.01
# Maximum age of joint_states, which makes a measured motion too long [s].
_JOINTS_AGE = 2.0 * PERIOD
# Faults that the command triggers itself, and those that the person causes.
_OWN = ("release", "silent hold", "emergency stop", "device/stop", "frozen driver")
_BY_HAND = {
    "unplugged adapter": "unplug the adapter or cable of the drives",
    "power loss": "switch the power of one drive off and on",
    "blocked axis": "block the stage gently",
}
_WITH_PEDAL = {"release": "release the pedal", "silent hold": "unplug the pedal"}
Ask = Callable[[str], str]


class Row(NamedTuple):
    """One line of the report.

    Attributes
    ----------
    rule, event : str
        Safety rule, and the event that stopped the motion.
    measured, bound : float
        Motion of the insertion axis [m].
    """

    rule: str
    event: str
    measured: float
    bound: float

    @property
    def passed(self) -> bool:
        """Whether the motion stays within its bound."""
        return not self.measured > self.bound


class Bench(ConformanceRig):
    """Real drives behind the driver, in real time, with the positions that the drives measure.

    Parameters
    ----------
    settings : DeviceDriverParameters
        Parameters of the driver.
    pedal : OperatorParameters or None
        Parameters of the person's pedal; None for emulated drives, which need no person.
    bag : Path
        Bag to record into.
    """

    runner: PacedRunner

    def __init__(self, settings: Any, pedal: OperatorParameters | None, bag: Path) -> None:
        self.settings, self.hand, self.driver = settings, RigClient(), DeviceDriver(settings)
        self.logged, self.commands = [], []
        components: list[Component] = [self.driver, self.hand]
        ports = settings.ports()
        self.has_pedal = pedal is not None
        if pedal is not None:
            components.append(Operator(pedal))
            ports = {**ports, INPUT_DEVICE: InputPort(pedal)}
        self.tap = BagTap(bag, components, (DIAGNOSTICS, LOG), {"purpose": "commissioning"})
        taps = (self._keep_log, self.tap)
        self.runner = PacedRunner(components, ports=ports, taps=taps)

    @property
    def place(self) -> tuple[float, float]:
        """Measured joint positions [m], [rad]."""
        return self.hand.joints

    def press(self) -> None:
        """Wait until the person presses the pedal; without a pedal, press the hold."""
        if not self.has_pedal:
            super().press()
            return
        print("Press the pedal, and keep it pressed.", flush=True)
        self.until(lambda: bool(self.hand.status.hold_owner), "the pedal")

    def release(self) -> None:
        """Wait until the person has released the pedal; without a pedal, release the hold."""
        super().release()
        if self.hand.status.hold_owner:
            print("Release the pedal.", flush=True)
            self.until(lambda: not self.hand.status.hold_owner, "the release of the pedal")

    def ask(self, text: str) -> str:
        """Return the person's answer; the driver continues to run in the meantime."""
        print(f"{text} [Enter]", flush=True)
        while not select.select([sys.stdin], [], [], 0.0)[0]:
            if self.runner.run(PERIOD):
                raise UserError(self.runner.exits[DRIVER].text)
        return sys.stdin.readline().strip()


def commission(rig: ConformanceRig, ask: Ask, *, has_pedal: bool = False) -> Iterator[Row]:
    """Run the commissioning; `ask` shows an instruction to the operator and returns the answer.

    Raises
    ------
    UserError
        If the drives are real and there is no pedal.
    """
    ask("No needle is mounted, and a hand is on the emergency stop.")
    rig.start()
    if not (has_pedal or rig.hand.status.simulated):
        raise UserError("real drives move only while a person holds: add a section `operator`")
    ask("The stage will move outwards to its switch.")
    rig.home()
    begin = rig.positions
    _enable(rig)
    rig.runner.run(_SETTLED)
    yield Row("no_motion_by_itself", "switched on", rig.distance(begin)[0], 0.0)
    for _ in range(round(_DISTANCE / _STEP)):
        _step(rig, 1.0)
        rig.until(lambda: rig.commands[-1] in rig.hand.results, "the end of a step")
    moved_mm = (rig.positions[0] - begin[0]) * 1e3
    answer = ask(f"The stage has moved {moved_mm:.3f} mm. Measure it, and type your value in mm.")
    measured_mm = number("value", answer, 0.0, 1e3, "mm") if answer else math.nan
    error = abs(measured_mm - moved_mm) * 1e-3
    yield Row("counts_per_unit", "10 mm by hand", error, 0.01 * _DISTANCE)
    faults = {fault.name: fault for fault in FAULTS if can_satisfy(fault.rule, rig.capabilities)}
    by_hand = _BY_HAND | (_WITH_PEDAL if has_pedal else {})
    for name in (name for name in (*_OWN, *_BY_HAND) if name in faults):
        _retract(rig)
        yield _stop(rig, faults[name], ask, by_hand.get(name, ""))
    rig.call("device/enable", False)


def _stop(rig: ConformanceRig, fault: Fault, ask: Ask, by_hand: str) -> Row:
    """Stop fast steps by an injected fault, or by an action of the person."""
    bound = largest_travel(fault, rig.capabilities, rig.settings)[0]
    bound += rig.settings.max_speed * _JOINTS_AGE
    if by_hand:
        ask(f"During the motion, {by_hand}.")
        before = _steps_until_stop(rig)
        ask("Undo it.")
        rig.release()
        rig.call("device/reset")
        rig.runner.run(0.5)
        measured = abs(rig.positions[0] - before) if rig.hand.status.homed else math.nan
        return Row(fault.rule.value, by_hand, measured, bound)
    _step(rig, _STEP_TIME)
    rig.runner.run(0.5 * _STEP_TIME)
    measured = rig.travel(lambda: fault.event(rig), _SETTLED)[0]
    return Row(fault.rule.value, fault.name, measured, bound)


def _steps_until_stop(rig: ConformanceRig) -> float:
    """Move in steps until one fails; return the last position before the failure [m]."""
    outcome = "succeeded"
    while outcome == "succeeded":
        _step(rig, _STEP_TIME)
        position, outcome = rig.positions[0], ""
        while not outcome and rig.state in ("HOLDING", "MOVING"):
            position = rig.positions[0]
            rig.runner.run(PERIOD)
            outcome = rig.hand.results.get(rig.commands[-1], "")
    rig.runner.run(_SETTLED)
    return position


def _step(rig: ConformanceRig, duration: float) -> None:
    """Enable and press if necessary, and begin a step."""
    if rig.state != "HOLDING":
        _enable(rig)
    if not rig.hand.status.hold_owner:
        rig.press()
    rig.command(rig.positions[0] + _STEP, rig.positions[1], duration)


def _enable(rig: ConformanceRig) -> None:
    """Reset a fault, home again if necessary, and enable the drives."""
    rig.release()
    rig.hand.actions.append(Publish(EMERGENCY_STOP, EmergencyStop(False)))
    if rig.state in ("FAULT", "ESTOPPED"):
        rig.call("device/reset")
    if not rig.hand.status.homed:
        rig.home()
    rig.call("device/enable", True)


def _retract(rig: ConformanceRig) -> None:
    """Retract to 0."""
    _enable(rig)
    rig.press()
    rig.hand.actions.append(Call("device/retract"))
    rig.runner.run(0.5)
    rig.until(lambda: rig.hand.status.activity == "none", "the end of the retraction")


def report(rows: Sequence[Row], person: str, day: datetime.date) -> str:
    """Return the report as Markdown."""
    table = "".join(
        f"| `{row.rule}` | {row.event} | {row.measured * 1e3:.3f} | {row.bound * 1e3:.3f} "
        f"| {'yes' if row.passed else 'NO'} |\n"
        for row in rows
    )
    return (
        f"# Commissioning of {day}\n\nMotion of the insertion axis after each event, from the bag "
        "next to this file; nan: the drive has lost its position.\n\n"
        f"| rule | event | measured [mm] | bound [mm] | within |\n| --- | --- | --- | --- | --- |\n"
        f"{table}\nCarried out by {person or '............'}, signature: ............\n"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    parser = CommandParser("commission", _DESCRIPTION, _EPILOG)
    parser.add_argument(
        "--params", type=Path, required=True, metavar="FILE", help="parameters of device_driver"
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="FOLDER", help="new folder for bag and report"
    )
    return run_command(lambda: _run(**vars(parser.parse_args(arguments))))


def _run(params: Path, out: Path) -> int:
    settings = read_driver_parameters(params)
    given = read_parameters(params, ["operator"]).get("operator")
    pedal = None if given is None else from_values(OperatorParameters, given, "operator")
    try:
        out.mkdir()
    except OSError as error:
        raise UserError(f"cannot make {out}: {error.strerror}") from error
    bench = Bench(settings, pedal, out / "bag")
    try:
        rows = []
        for row in commission(bench, bench.ask, has_pedal=bench.has_pedal):
            rows.append(row)
            print(f"{row.rule}: {row.event}: {row.measured * 1e3:.3f} mm", flush=True)
        person = bench.ask("Type your name for the report.")
    finally:
        bench.runner.stop(DRIVER)
        bench.runner.run(2.0)
        bench.runner.close()
        bench.tap.close()
    (out / "report.md").write_text(report(rows, person, datetime.date.today()), "utf-8")
    return EXIT_DONE if all(row.passed for row in rows) else EXIT_MISSED


if __name__ == "__main__":
    sys.exit(main())
