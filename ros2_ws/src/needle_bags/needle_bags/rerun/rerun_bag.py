"""Copy of a bag with the outputs of the current code."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from needle_bags.format.bag_writer import BagCopy, stamp_of, standard_topic, string_message
from needle_bags.reading.bag_messages import raw_as_sent, read_contents
from needle_bags.reading.bag_reader import CALIBRATION, Run
from needle_bags.recording.provenance import commit
from needle_bags.rerun.bag_pass import TIP_TOPICS
from needle_bags.rerun.rerun_text import outputs_table
from needle_bags.rerun.stages import Output
from needle_bags.run.run_summary import steered_by
from needle_core.errors import UserError
from needle_core.files.file_access import replace_file

TABLE = "outputs.txt"


def write_rerun(
    run: Run,
    target: Path,
    outputs: Sequence[Output],
    parameters: Mapping[str, Mapping[str, Any]],
    calibration: str,
    *,
    shown: Sequence[Output] = (),
) -> None:
    """Write the copy, and the outputs as text into `outputs.txt`.

    Parameters
    ----------
    run : Run
        The run; its bag is read again.
    target : Path
        The new bag's directory.
    outputs : sequence of Output
        Outputs of the current code. Other topics keep the recorded messages; so do the tracker's
        topics for stamps without outputs, whose images are not in the bag.
    parameters : mapping
        Parameters by full node name.
    calibration : str
        The calibration.
    shown : sequence of Output
        Outputs of the viewers, which replace all recorded messages of their topics.

    Raises
    ------
    UserError
        If the bag is broken, or the new one exists already or cannot be written.
    """
    waiting: dict[tuple[str, int], deque[Output]] = defaultdict(deque)
    for output in outputs:
        waiting[output.topic, output.stamp].append(output)
    topics = {output.topic for output in outputs}
    shown_topics = {output.topic for output in shown}
    answered = {output.stamp for output in outputs if output.topic in TIP_TOPICS}
    contents = read_contents(run.path)
    custom = {**contents.custom_data, "calibration": calibration}
    copy = BagCopy(target, contents.distribution, {**custom, **_changed(run, custom, parameters)})
    for message in raw_as_sent(run.path, lambda _: True):
        topic = contents.topics[message.topic]
        name = topic.name.removeprefix(run.namespace)
        data = message.data
        if name in shown_topics:
            continue
        if name == CALIBRATION:
            data = string_message(calibration)
        if name in topics:
            stamp = stamp_of(data)
            if name not in TIP_TOPICS or stamp in answered:
                if not waiting[name, stamp]:
                    continue
                data = waiting[name, stamp].popleft().data
        copy.put(topic, data, message.log_time, message.time)
    rest = (output for queue in waiting.values() for output in queue)
    for output in sorted((*rest, *shown), key=lambda output: output.log_time):
        new = standard_topic(run.namespace + output.topic, output.type_name)
        copy.put(new, output.data, output.log_time, output.log_time)
    copy.close()
    try:
        replace_file(target / TABLE, outputs_table(run, outputs).encode())
    except OSError as error:
        raise UserError(f"cannot write {target / TABLE}: {error.strerror}") from error


def _changed(
    run: Run, custom: Mapping[str, str], parameters: Mapping[str, Mapping[str, Any]]
) -> dict[str, str]:
    """Return the custom data that differ from the original bag."""
    every = {**run.parameters, **{name: _plain(values) for name, values in parameters.items()}}
    document = {name: {"ros__parameters": values} for name, values in every.items()}
    presets = {v["preset"] for v in parameters.values() if "preset" in v}
    info = {**run.run_info, "rerun_of": run.path.absolute().name}
    # The command of the original run does not reproduce this bag.
    info.pop("command", None)
    if steered_by(run) is not None:
        info["steered_by"] = steered_by(run)
    if presets:
        info["controller"] = presets.pop()
    return {
        "parameters": yaml.safe_dump(document),
        "run_info": yaml.safe_dump(info),
        "commit": commit(),
    }


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    return {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}
