"""`rerun`: processes the images and tips of a bag with the current code."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from needle_bags.format.bag_writer import refuse_existing_bag
from needle_bags.link.openigtlink import LINK, Listeners, OpenIGTLink, OpenIGTLinkParameters
from needle_bags.live.live_view import LiveView, LiveViewParameters
from needle_bags.reading.bag_messages import read_messages
from needle_bags.reading.bag_reader import Run, read_run
from needle_bags.rerun.bag_pass import (
    TIP_TOPICS,
    estimate_errors,
    has_images,
    run_again,
    run_stage,
    run_tips,
)
from needle_bags.rerun.comparison import compare
from needle_bags.rerun.rerun_bag import write_rerun
from needle_bags.rerun.rerun_text import describe, errors_text, flat, tolerance_table
from needle_bags.rerun.stages import BagStage
from needle_bags.ros.controller_rerun import ControllerStage, step_ends
from needle_bags.ros.parameter_snapshots import plain_value
from needle_controller.presets.own_parts import GROUPS
from needle_controller.presets.steering_settings import PRESETS, SteeringSettings
from needle_controller.protocol.joint_history import JointSample
from needle_core.commands.cli import EXIT_DONE, EXIT_MISSED, run_command, write_json
from needle_core.commands.options import CommandParser, output_file
from needle_core.component import Moment
from needle_core.errors import UserError
from needle_core.files.yaml_files import load_yaml, read_calibration
from needle_core.messages import Text
from needle_core.ros.parameters import COMMON_PARAMETERS
from needle_core.settings.parameter_files import (
    Sections,
    missing_section_warning,
    read_sections,
    values_for,
)
from needle_tracker.optics.calibration import parse_calibration
from needle_tracker.stereo_tracker import CALIBRATION, TIP_POSE, StereoTipTracker
from needle_tracker.tracker_parameters import StereoTrackerParameters

DESCRIPTION = """\
Process a bag with the current code, offline: its images with the tracker, its tips with the
estimator, law and step protocol, with the recorded parameters and calibration. Compares every
output with the recorded one, field by field, and prints the differences.

Joints, tips and answers of the device remain the recorded ones: the needle follows its recorded
path.

With --viewers, live_view and openigtlink process the recorded needle as well. Their messages are
counted, not compared, because a bag has neither their timing nor data of ports; --output writes
their topics.
"""
EPILOG = f"""\
examples:
  ros2 run needle_bags rerun bags/my_run
      check that the current code gives the recorded results
  ros2 run needle_bags rerun bags/my_run --preset best
      estimates and commands of the controller `best` for the recorded tips
  ros2 run needle_bags rerun bags/my_run --params other.yaml --output bags/again
  ros2 run needle_bags report bags/my_run bags/again
      compare with other parameters, in one report
  ros2 run needle_bags rerun bags/my_run --viewers --output bags/shown
      a bag for Foxglove, with markers, and images with shaft and tip

tolerances: a value may differ by absolute + relative x recorded
{tolerance_table()}

exit codes: 0 no difference; 1 differences; 2 invalid or missing input; 3 the current code failed;
130 interrupted
"""
FILE = "calibration_file"
TRACKER, CONTROLLER = "stereo_tracker", "plane_controller"
NOT_COMPARED = {
    LiveView.name: "because its update times are not recorded",
    OpenIGTLink.name: "because ports are not recorded",
}
"""Reason why the output of each viewer is not compared."""

P = TypeVar("P")


@dataclasses.dataclass(frozen=True)
class Node:
    """A recorded node.

    Attributes
    ----------
    name : str
        Full name of the node.
    values : mapping
        Parameters of the node, including those of --params.
    given : frozenset of str
        Names of the parameters in --params.
    """

    name: str
    values: Mapping[str, Any]
    given: frozenset[str]

    def parameters(self, kind: type[P]) -> P:
        """Return the parameters as a dataclass; warn about those that no longer exist."""
        names = {field.name for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
        known = {name: value for name, value in self.values.items() if name in names}
        unknown = [n for n in self.values if n not in names and not n.startswith(COMMON_PARAMETERS)]
        refused = self.given.intersection(unknown)
        if refused:
            raise UserError(f"--params: {self.name} has no parameter {', '.join(sorted(refused))}")
        if unknown:
            text = f"{self.name} no longer has {', '.join(unknown)}: left out"
            print(f"warning: {text}", file=sys.stderr)
        plain = {k: tuple(v) if isinstance(v, list) else v for k, v in known.items()}
        try:
            return kind(**plain)
        except UserError as error:
            raise UserError(f"{self.name}: {error}") from error


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `rerun`; return its exit code."""
    argv = sys.argv[1:] if arguments is None else list(arguments)
    return run_command(lambda: _run(argv))


def _run(argv: Sequence[str]) -> int:
    given = _parser().parse_args(argv)
    file = output_file("--json", given.json)
    if given.output is not None:
        refuse_existing_bag(given.output)
    sections = read_sections(given.params) if given.params is not None else {}
    if given.preset is not None and given.preset not in PRESETS:
        raise UserError(f"--preset {given.preset!r} is not one of {', '.join(PRESETS)}")
    named = {key: getattr(given, key) for key in ("preset", *GROUPS)}
    overrides = {key: name for key, name in named.items() if name is not None}
    run = read_run(given.bag, given.namespace)
    params = (given.params, sections)
    tracker_node = _node(run, TRACKER, params, {}) if has_images(run) else None
    controller_node = _node(run, CONTROLLER, params, overrides)
    reached = controller_node.given.difference(overrides) or (tracker_node and tracker_node.given)
    if given.params is not None and not reached:
        print(f"warning: {missing_section_warning(*params, controller_node.name)}", file=sys.stderr)
    calibration = run.calibration if tracker_node is None else _calibration(run, tracker_node)
    tracker = None if tracker_node is None else _tracker(run, tracker_node, calibration)
    ends = step_ends(run.path, run.namespace)
    controller = _controller(controller_node, ends)
    rerun = run_again(run, tracker, controller)
    comparison = compare(rerun.recorded, rerun.today)
    errors = {"recorded": estimate_errors(run), "today": estimate_errors(run, rerun.outputs)}
    viewers = _viewers(run, params, calibration) if given.viewers else {}
    shown = [output for viewer in viewers.values() for output in run_stage(run, viewer)]

    if file is not None:
        sent = [item for viewer in viewers.values() for item in viewer.runner.counts.items()]
        counts = {f"{what.replace('/', '_')}_sent": count for what, count in sent}
        write_json(file, {**flat(run, comparison, errors), **counts})
    if given.output is not None:
        outputs = rerun.outputs
        answers = [output for output in outputs if output.topic in TIP_TOPICS]
        if answers:
            outputs = [*answers, *run_tips(run, _controller(controller_node, ends), answers)]
        nodes = [node for node in (tracker_node, controller_node) if node is not None]
        used = {node.name: node.values for node in nodes}
        write_rerun(run, given.output, outputs, used, calibration, shown=shown)
    print(f"{run.path}: {_summary(tracker, controller)}")
    for note in controller.notes:
        print(f"note: {note}")
    if rerun.tips_without_images:
        print(f"note: {rerun.tips_without_images} recorded tips have no images in the bag")
    if rerun.unanswered:
        print(f"note: {rerun.unanswered} pairs are left out: stereo_tracker did not receive them")
    print("CHANGED" if comparison.changed else f"UNCHANGED: {len(rerun.recorded)} messages agree")
    for text in (
        describe(run, comparison),
        errors_text(errors),
        _viewer_counts(viewers),
    ):
        if text:
            print(text)
    if given.output is not None:
        print(f"written: {given.output}")
    return EXIT_MISSED if comparison.changed else EXIT_DONE


def _parser() -> CommandParser:
    parser = CommandParser("rerun", DESCRIPTION, EPILOG)
    add = parser.add_argument
    add("bag", type=Path, metavar="BAG", help="directory of the bag, or a file")
    add("--preset", metavar="|".join(PRESETS), help="controller in place of the recorded one")
    for kind in GROUPS:
        add(
            f"--{kind}",
            metavar="NAME",
            help=f"{kind} of another package (docs/own_controllers.md); '': the preset's",
        )
    add("--params", type=Path, metavar="FILE", help="ROS parameter file that overrides the bag's")
    add(
        "--output",
        type=Path,
        metavar="NEW_BAG",
        help="write a copy of the bag with the new outputs in place of the recorded ones",
    )
    add(
        "--viewers",
        action="store_true",
        help="also run live_view and openigtlink, and count their messages",
    )
    add("--namespace", metavar="NS", help="namespace of the rig, if the bag has several")
    add("--json", type=Path, metavar="FILE", help="also write the result as flat JSON")
    return parser


def _node(
    run: Run,
    name: str,
    params: tuple[Path | None, Sections],
    overrides: Mapping[str, str],
    *,
    has_defaults: bool = False,
) -> Node:
    recorded = run.parameters or _announced(run)
    found = [full for full in recorded if full.rsplit("/", maxsplit=1)[-1] == name]
    own = f"{run.namespace}{name}"
    full_name = found[0] if found and own not in found else own
    given = {**(values_for(*params, full_name, name) or {}), **overrides}
    if not (found or given or has_defaults):
        raise UserError(
            f"{run.path} has no parameters of {name} (recorded by another recorder?): give them "
            f"with --params"
        )
    return Node(full_name, {**recorded.get(full_name, {}), **given}, frozenset(given))


def _announced(run: Run) -> dict[str, dict[str, Any]]:
    """Return the parameters that nodes announced at their start, by full name.

    A bag from ROS 2's own recorder contains no other parameters.
    """
    found: dict[str, dict[str, Any]] = {}
    for _, _, message in read_messages(run.path, "/parameter_events".__eq__):
        values = found.setdefault(str(message.node), {})
        for parameter in message.new_parameters:
            if parameter.value.type:
                values[str(parameter.name)] = plain_value(parameter.value)
    return {node: values for node, values in found.items() if values}


def _calibration(run: Run, node: Node) -> str:
    """Return the text of the calibration from --params, or of the recorded one."""
    if FILE in node.given:
        return read_calibration(Path(str(node.values[FILE])))
    if not run.calibration:
        raise UserError(
            f"{run.path} has images but no calibration: name one with --params "
            f"({TRACKER}: {{ros__parameters: {{{FILE}: ...}}}})"
        )
    return run.calibration


def _tracker(run: Run, node: Node, text: str) -> BagStage:
    try:
        calibration = parse_calibration(load_yaml(text))
    except (UserError, ValueError) as error:
        raise UserError(f"{run.path}: the calibration is broken: {error}") from error
    tracker = StereoTipTracker(node.parameters(StereoTrackerParameters), calibration)
    return BagStage(tracker, TIP_TOPICS)


def _viewers(
    run: Run, params: tuple[Path | None, Sections], calibration: str
) -> dict[str, BagStage]:
    """Return the viewers: live_view, and openigtlink with one client."""
    begin = Moment(0.0, 0)

    def settings(name: str, kind: type[P]) -> P:
        return _node(run, name, params, {}, has_defaults=True).parameters(kind)

    # Keep the recorded /tf, because other nodes publish it as well.
    view = LiveView(settings(LiveView.name, LiveViewParameters), transforms=False)
    viewers = {view.name: BagStage(view, (output.topic for output in view.outputs))}
    # Deliver the calibration here, because not every bag contains its topic.
    list(viewers[view.name].runner.deliver(CALIBRATION, Text(calibration), begin))
    if importlib.util.find_spec("pyigtl") is not None:
        link = OpenIGTLink(settings(OpenIGTLink.name, OpenIGTLinkParameters))
        viewers[link.name] = BagStage(link, ())
        viewers[link.name].runner.arrive(LINK, (Listeners(1),), begin)
    return viewers


def _viewer_counts(viewers: Mapping[str, BagStage]) -> str:
    """Return one line per viewer, or an empty string if there are none."""
    lines = []
    for name, viewer in viewers.items():
        counts = ", ".join(f"{count} {what}" for what, count in viewer.runner.counts.items())
        lines.append(
            f"{name}: nothing to compare, {NOT_COMPARED[name]}; sent {counts or 'nothing'}"
        )
    if viewers and OpenIGTLink.name not in viewers:
        lines.append(f"{OpenIGTLink.name}: left out, pyigtl is not installed (docs/viewers.md)")
    return "\n".join(lines)


def _controller(node: Node, ends: Mapping[int, JointSample]) -> ControllerStage:
    return ControllerStage(node.parameters(SteeringSettings), node.name, ends)


def _summary(tracker: BagStage | None, controller: ControllerStage) -> str:
    pairs = (
        ""
        if tracker is None
        else f"{tracker.runner.counts[TIP_POSE]} image pairs through {TRACKER}, "
    )
    return f"{pairs}{controller.tips} tips through {CONTROLLER} ({controller.name})"


if __name__ == "__main__":
    sys.exit(main())
