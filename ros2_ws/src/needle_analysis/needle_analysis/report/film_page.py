"""The film in the page: its last frame, and a script that shows the others."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from needle_analysis.figures.film import READINGS, Frame
from needle_analysis.figures.film_views import View

_FRAMES_PER_SECOND = 8
_SCRIPT = """
(() => {
  const film = JSON.parse(document.getElementById("film-data").textContent);
  const root = document.querySelector(".film"), last = film.readings.length - 1;
  const slider = root.querySelector("input"), button = root.querySelector("button");
  const views = [...root.querySelectorAll(".view")];
  const told = [...root.querySelectorAll("dd")];
  let timer = 0;
  const show = (frame) => {
    slider.value = frame;
    slider.setAttribute("aria-valuetext", `${frame + 1} of ${last + 1}, ` +
      film.readings[frame][0]);
    film.readings[frame].forEach((text, number) => { told[number].textContent = text; });
    film.views.forEach((view, number) => {
      const picture = views[number].querySelector("img");
      if (view.pictures) {
        const data = view.pictures[frame];
        picture.style.visibility = data ? "" : "hidden";
        if (data) picture.src = "data:image/jpeg;base64," + data;
      }
      const points = view.lines[frame];
      for (const line of views[number].querySelectorAll("polyline")) {
        line.setAttribute("points", points);
      }
      const [x, y] = points.split(" ").pop().split(",");
      for (const ring of views[number].querySelectorAll("circle")) {
        ring.style.visibility = points ? "" : "hidden";
        if (points) { ring.setAttribute("cx", x); ring.setAttribute("cy", y); }
      }
    });
  };
  const stop = () => { clearInterval(timer); timer = 0; button.textContent = "Play"; };
  const advance = () => {
    if (+slider.value === last) stop(); else show(+slider.value + 1);
  };
  const play = () => {
    if (+slider.value === last) show(0);
    timer = setInterval(advance, 1000 / film.rate);
    button.textContent = "Pause";
  };
  button.addEventListener("click", () => { if (timer) stop(); else play(); });
  slider.addEventListener("input", () => { stop(); show(+slider.value); });
  show(last);
  root.querySelector(".controls").hidden = false;
})();
"""


def film_html(frames: Sequence[Frame], views: Sequence[View]) -> str:
    """Return the film; without a script, and on paper, it is its last frame.

    Parameters
    ----------
    frames : sequence of Frame
        In their order; one at least.
    views : sequence of View
        What is shown of them.
    """
    last = len(frames) - 1
    readings = "".join(
        f"<div><dt>{name}</dt><dd>{html.escape(value)}</dd></div>"
        for name, value in zip(READINGS, frames[last].readings, strict=True)
    )
    data = {
        "rate": _FRAMES_PER_SECOND,
        "readings": [frame.readings for frame in frames],
        "views": [
            {
                "pictures": None if view.is_chart else [_text(data) for data in view.pictures],
                "lines": [_points(line) for line in view.lines],
            }
            for view in views
        ],
    }
    # A script must not end where a text in it says so.
    told = json.dumps(data, separators=(",", ":"), ensure_ascii=False).replace("<", "\\u003c")
    return (
        '<div class="film"><div class="controls" hidden><button type="button">Play</button>'
        f'<input type="range" min="0" max="{last}" value="{last}" step="1" aria-label="Frame">'
        f'</div><dl class="readings">{readings}</dl>'
        f'<div class="views">{"".join(_view(view, last) for view in views)}</div></div>'
        f'<script type="application/json" id="film-data">{told}</script>'
        f"<script>{_SCRIPT}</script>"
    )


def _view(view: View, frame: int) -> str:
    width, height = view.size
    points = _points(view.lines[frame])
    x, y = (points.rpartition(" ")[2] or "0,0").split(",")
    hidden = "" if points else ' style="visibility:hidden"'
    ring = f'cx="{x}" cy="{y}" r="{width / 80:.1f}"{hidden}'
    if view.is_chart:
        kind, source = "chart", f"data:image/png;base64,{_text(view.pictures[0])}"
    else:
        kind, source = "photo", f"data:image/jpeg;base64,{_text(view.pictures[frame])}"
    alt = html.escape(view.name)
    return (
        f'<figure class="view {kind}"><div class="stack">'
        f'<img class="{kind}" alt="{alt}" width="{width}" height="{height}" src="{source}">'
        f'<svg viewBox="0 0 {width} {height}" aria-hidden="true">'
        f'<polyline class="under" points="{points}"/><circle class="under" {ring}/>'
        f'<polyline class="needle" points="{points}"/><circle class="tip" {ring}/>'
        f"</svg></div><figcaption>{alt}</figcaption></figure>"
    )


def _points(line: npt.NDArray[np.float64]) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in line.tolist())


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
