// Hover values, linked cursors and click-to-seek for the SVG plots, from what they carry in `data-plot`.
Poise.plots = (replay) => {
  const tip = document.getElementById("tip");
  const NS = "http://www.w3.org/2000/svg";
  const show = (v) => (v === null ? "–" : Math.abs(v) >= 1e4 ? v.toLocaleString("en", { maximumFractionDigits: 0 }) : String(Number(v.toPrecision(4))));
  for (const svg of document.querySelectorAll("svg[data-plot]")) {
    const plot = JSON.parse(svg.dataset.plot);
    const figure = svg.closest("figure");
    const timed = figure.dataset.time === "1";
    const line = (name) => {
      const el = document.createElementNS(NS, "line");
      el.setAttribute("class", name);
      el.setAttribute("y1", plot.py[0]);
      el.setAttribute("y2", plot.py[1]);
      el.style.display = "none";
      svg.appendChild(el);
      return el;
    };
    const place = (el, x) => {
      const px = plot.px[0] + ((x - plot.x[0]) / (plot.x[1] - plot.x[0])) * (plot.px[1] - plot.px[0]);
      el.setAttribute("x1", px);
      el.setAttribute("x2", px);
      el.style.display = "";
    };
    const hover = line("pp-hover");
    if (timed && replay) {
      const cursor = line("pp-cursor");
      replay.onFrame((t) => place(cursor, t / replay.fps));
    }
    const valueAt = (e) => {
      const box = svg.getBoundingClientRect();
      const u = ((e.clientX - box.left) / box.width) * plot.w;
      const x = plot.x[0] + ((u - plot.px[0]) / (plot.px[1] - plot.px[0])) * (plot.x[1] - plot.x[0]);
      return Math.min(plot.x[1], Math.max(plot.x[0], x));
    };
    const nearest = (xs, x) => {
      let best = 0;
      for (let k = 1; k < xs.length; k++) if (Math.abs(xs[k] - x) < Math.abs(xs[best] - x)) best = k;
      return best;
    };
    svg.addEventListener("pointermove", (e) => {
      const x = valueAt(e);
      place(hover, x);
      tip.replaceChildren();
      const head = document.createElement("b");
      head.textContent = `${show(x)} ${figure.dataset.unit || ""}`;
      tip.append(head);
      for (const s of plot.series) {
        if (!s.x.length) continue;
        const row = document.createElement("span");
        const dot = document.createElement("i");
        dot.style.background = s.color;
        row.append(dot, `${s.name}: ${show(s.y[nearest(s.x, x)])}`);
        tip.append(row);
      }
      tip.hidden = false;
      const wide = tip.offsetWidth;
      tip.style.left = `${Math.max(8, Math.min(innerWidth - wide - 8, e.clientX + 14))}px`;
      tip.style.top = `${e.clientY + 16}px`;
    });
    svg.addEventListener("pointerleave", () => { tip.hidden = true; hover.style.display = "none"; });
    if (timed && replay) svg.addEventListener("click", (e) => replay.seek(valueAt(e) * replay.fps, true));
  }
};

// Starts the page and says on the root element how it went, for people's tests and ours.
(() => {
  const root = document.documentElement;
  window.addEventListener("error", (e) => {
    root.dataset.status = "error";
    root.dataset.error = String(e.message);
  });
  const data = Poise.decode(JSON.parse(document.getElementById("motion").textContent));
  const replay = Poise.replay(data);
  Poise.plots(replay);
  root.dataset.view = replay.kind;
  requestAnimationFrame(() => requestAnimationFrame(() => {
    if (root.dataset.status !== "error") root.dataset.status = "ready";
  }));
})();
