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
