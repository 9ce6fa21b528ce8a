"""Options of `monte_carlo` for disturbances of tips, tissue and needle."""

from __future__ import annotations

import argparse
import math
from typing import Any

from needle_core.commands.options import CommandParser, number, whole_number
from needle_core.errors import UserError
from needle_sim.studies.disturbances import Disturbances

_NOISE_MM = "1"
_SHAPES = ("uniform", "normal")


def add_disturbance_options(parser: CommandParser) -> None:
    """Add the options to a parser."""
    add = parser.add_argument
    numbers = (
        (
            "--noise-mm",
            _NOISE_MM,
            "A",
            "error of each coordinate of a measured tip [mm]: maximum of uniform noise, standard "
            "deviation of normal noise",
        ),
        ("--noise-shape", "uniform", "|".join(_SHAPES), "distribution of that noise"),
        ("--outliers", "0", "F", "share of tips with an additional error in a random direction"),
        ("--outlier-mm", "5,10", "LO,HI", "range of that error [mm], uniform"),
        ("--found", "1", "F", "share of exposures in which the tip is found"),
        ("--delay", "0", "N", "delay of a measurement, in steps, known to the controller"),
        ("--untold-delay", "0", "N", "delay of a measurement, in steps, unknown to the controller"),
        ("--kappa-scale", "1", "S", "true curvature relative to the assumed one"),
        ("--kappa-patches", "0", "F", "maximum relative error of the curvature, new every 20 mm"),
        (
            "--push",
            "0",
            "K",
            "additional curvature of the path by the tissue [1/m], in a fixed random direction "
            "per needle",
        ),
        ("--rotation-gain", "1", "G", "share of the base's rotation that reaches the tip"),
        (
            "--roll-walk",
            "0",
            "D",
            "random rotation of the tip about its axis: standard deviation over 1 mm [deg]; it "
            "grows with the square root of the insertion",
        ),
        ("--play-deg", "0", "D", "dead band between base and tip angle, +-D [deg]"),
        ("--lag-mm", "0", "L", "first-order lag of the tip angle, as inserted length [mm]"),
        ("--slip", "0", "F", "slip: the stage moves farther than the needle by this share"),
        ("--bump-mm", "0", "D", "displacement of phantom and needle at half the depth [mm]"),
    )
    for name, default, metavar, text in numbers:
        add(name, default=default, metavar=metavar, help=f"{text} (default: {default})")
    add(
        "--correlated",
        metavar="R",
        help="instead of that noise: normal errors with the variance of uniform ones within "
        "--noise-mm (0.577 mm for 1 mm), and correlation R in [0, 0.999] to the previous error",
    )
    add(
        "--student",
        metavar="DOF,SCALE_MM",
        help="instead of that noise: errors with Student's t distribution with DOF degrees of "
        "freedom, times SCALE_MM",
    )
    add(
        "--bias-walk",
        metavar="A",
        help="instead of that noise: a bias of each measured coordinate within +-A mm, which "
        "changes by +-A/10 between exposures, and uniform noise within +-0.3 A. For a camera that "
        "is worse than specified: --claimed-mm 0.03 --bias-walk 0.3",
    )
    add(
        "--layer",
        metavar="S,FROM_MM",
        help="tissue layer with S times the curvature, from the first step that begins at FROM_MM "
        "or deeper",
    )


def disturbances_of(given: argparse.Namespace) -> Disturbances:
    """Return the disturbances of the options.

    Raises
    ------
    UserError
        If a value is out of bounds, or two kinds of noise are given.
    """
    return Disturbances(
        **_noise(given),
        outliers=number("--outliers", given.outliers, 0.0, 1.0, "-"),
        outlier_size=_outlier_size(given.outlier_mm),
        found=number("--found", given.found, 0.0, 1.0, "-"),
        delay=whole_number("--delay", given.delay, 0, 100),
        hidden_delay=whole_number("--untold-delay", given.untold_delay, 0, 100),
        curvature_scale=number("--kappa-scale", given.kappa_scale, 0.05, 20.0, "-"),
        curvature_patches=number("--kappa-patches", given.kappa_patches, 0.0, 0.95, "-"),
        layer=_layer(given.layer),
        push=number("--push", given.push, 0.0, 20.0, "1/m"),
        rotation_gain=number("--rotation-gain", given.rotation_gain, 0.0, 2.0, "-"),
        roll_walk=math.radians(
            number("--roll-walk", given.roll_walk, 0.0, 90.0, "deg/sqrt(mm)") / math.sqrt(1e-3)
        ),
        play=math.radians(number("--play-deg", given.play_deg, 0.0, 180.0, "deg")),
        lag_length=number("--lag-mm", given.lag_mm, 0.0, 1000.0, "mm") * 1e-3,
        slip=number("--slip", given.slip, -0.5, 2.0, "-"),
        bump=number("--bump-mm", given.bump_mm, 0.0, 100.0, "mm") * 1e-3,
    )


def _noise(given: argparse.Namespace) -> dict[str, Any]:
    """Return the settings of the tip noise, which must be of one kind."""
    kinds = [name for name in ("correlated", "student", "bias_walk") if getattr(given, name)]
    if len(kinds) > 1 or (kinds and given.noise_shape != "uniform"):
        names = [f"--{name.replace('_', '-')}" for name in kinds]
        others = [f"--noise-shape {given.noise_shape}"] if given.noise_shape != "uniform" else []
        raise UserError(f"{' and '.join(names + others)} are alternative kinds of noise: give one")
    if given.noise_shape not in _SHAPES:
        raise UserError(f"--noise-shape {given.noise_shape!r} is not {' or '.join(_SHAPES)}")
    if given.noise_mm != _NOISE_MM and (given.student or given.bias_walk):
        raise UserError(
            "--noise-mm cannot be combined with --student and --bias-walk, which set their own"
        )
    noise = number("--noise-mm", given.noise_mm, 0.0, 20.0, "mm") * 1e-3
    if given.correlated:
        lasting = number("--correlated", given.correlated, 0.0, 0.999, "-")
        return {
            "noise": noise / math.sqrt(3.0), "noise_shape": "normal", "noise_lasting": lasting
        }  # fmt: skip
    if given.student:
        freedom, scale = _pair("--student", given.student, "DOF,SCALE_MM", "3,0.3")
        return {
            "noise_shape": "student",
            "degrees_of_freedom": number("--student DOF", freedom, 1.0, 1000.0, "-"),
            "noise": number("--student SCALE_MM", scale, 0.0, 20.0, "mm") * 1e-3,
        }
    if given.bias_walk:
        bias = number("--bias-walk", given.bias_walk, 0.0, 20.0, "mm") * 1e-3
        return {"noise": 0.3 * bias, "bias_walk": bias}
    return {"noise": noise, "noise_shape": given.noise_shape}


def _layer(text: str | None) -> tuple[float, float]:
    if text is None:
        return 1.0, 0.0
    factor, begins = _pair("--layer", text, "S,FROM_MM", "0.3,60")
    return (
        number("--layer S", factor, 0.05, 20.0, "-"),
        number("--layer FROM_MM", begins, 0.0, 1000.0, "mm") * 1e-3,
    )


def _pair(name: str, text: str, form: str, example: str) -> tuple[str, str]:
    parts = text.split(",")
    if len(parts) != 2:
        raise UserError(f"{name} {text!r} is not {form}, such as {example}")
    return parts[0], parts[1]


def _outlier_size(text: str) -> tuple[float, float]:
    least, most = _pair("--outlier-mm", text, "LO,HI", "5,10")
    low = number("--outlier-mm LO", least, 0.0, 1000.0, "mm")
    high = number("--outlier-mm HI", most, low, 1000.0, "mm")
    return low * 1e-3, high * 1e-3
