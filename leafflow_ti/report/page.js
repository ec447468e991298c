/* The frame slider, and what follows it: maps, arrows on them, marks in the curves, the surface. */

(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const byId = (id) => document.getElementById(id);
  const figures = [...document.querySelectorAll("figure[data-panel]")].map((figure) => {
    const key = figure.dataset.panel, image = figure.querySelector(".plate img");
    data.images[key][data.start] = image.src; // the page holds the first frame's image once
    return { figure, key, image, paths: [...figure.querySelectorAll(".plate path")] };
  });
  let current = data.start, view = null;

  function startView() {
    const canvas = byId("surface");
    if (!canvas) return;
    const select = byId("colour"), arrows = byId("arrows"), stretch = byId("stretch"), ruler = byId("ruler");
    try {
      view = new SurfaceView(canvas, data.surface, (drawn) => {
        const most = 0.3 * canvas.clientWidth / drawn.scale, power = 10 ** Math.floor(Math.log10(most));
        const length = [5, 2, 1].find((m) => m * power <= most) * power;
        ruler.textContent = length >= 1 ? `${length} mm` : `${+(1000 * length).toPrecision(1)} µm`;
        ruler.style.width = `${length * drawn.scale}px`;
      });
    } catch (reason) {
      byId("view").querySelector(".tools").hidden = true;
      byId("view").dataset.missing = reason.message;
      canvas.remove();
      return;
    }
    byId("no-webgl").remove();
    ruler.hidden = false;
    const colour = () => {
      const shown = figures.find((f) => f.key === select.value);
      byId("scale").replaceChildren(shown.figure.querySelector(".key").cloneNode(true));
      paint();
    };
    const setArrows = () => {
      view.arrows(arrows.checked, +stretch.value);
      stretch.disabled = !arrows.checked;
      byId("stretch-text").textContent = `${+view.magnification.toPrecision(2)} × the motion of a frame`;
    };
    select.addEventListener("change", colour);
    byId("home").addEventListener("click", () => view.home());
    if (arrows) {
      arrows.addEventListener("change", setArrows);
      stretch.addEventListener("input", setArrows);
      setArrows();
    }
    view.recolour = colour;
  }

  /** Colours the surface with the image of the map chosen, in the frame shown. */
  async function paint() {
    const wanted = current, image = new Image();
    image.src = data.images[byId("colour").value][wanted];
    await image.decode();
    if (wanted === current && view) view.paint(image);
  }

  function show(index) {
    current = index;
    for (const { key, image, paths } of figures) {
      image.src = data.images[key][index];
      for (const path of paths) path.setAttribute("d", data.arrows[key][index]);
    }
    for (const mark of document.querySelectorAll(".now")) {
      const x = mark.dataset.at.split(" ")[index];
      mark.setAttribute("x1", x);
      mark.setAttribute("x2", x);
    }
    const label = byId("frame-label");
    if (label) {
      label.textContent = data.labels[index];
      byId("frame").setAttribute("aria-valuetext", data.labels[index]);
    }
    if (view) {
      view.show(index);
      paint();
    }
  }

  function startSlider() {
    const slider = byId("frame"), play = byId("play");
    if (!slider) return;
    let timer = 0;
    const stop = () => {
      clearInterval(timer);
      timer = 0;
      play.textContent = "Play";
    };
    slider.addEventListener("input", () => {
      stop();
      show(+slider.value);
    });
    play.addEventListener("click", () => {
      if (timer) return stop();
      play.textContent = "Pause";
      timer = setInterval(() => {
        slider.value = (current + 1) % data.labels.length;
        show(+slider.value);
      }, 450);
    });
  }

  startView();
  startSlider();
  show(current);
  if (view) view.recolour();
})();
