// Draws the figures of the selected fitted model and test run, and shows their tables.
// Names and units are data: the page gets them as text, Plotly (which reads tags in texts) escaped.
"use strict";
(() => {
  const { axis, base, byId, clear, css, draw, narrow, node, nothing, panels, safe } = panel;
  const data = JSON.parse(document.getElementById("data").textContent);
  const picks = { model: byId("pick-model"), run: byId("pick-run") };
  const span = { from: byId("from"), to: byId("to") };
  const hiddenVariants = new Set();
  const dark = window.matchMedia("(prefers-color-scheme: dark)");

  const array = (index) => unpack(data.blobs, index);
  const labelled = (name, unit) => "<b>" + safe(name) + "</b>" + (unit ? "  " + safe(unit) : "");
  const squared = (unit) => (unit ? (/^[\w%]+$/.test(unit) ? unit : `(${unit})`) + "²/Hz" : "1/Hz");
  const short = (value) => Number(value.toPrecision(5)).toString();

  const model = () => data.models[Number(picks.model.value)];
  const run = () => model().runs[Number(picks.run.value)];
  const curve = (index) => css(`--curve-${(index % 5) + 1}`);

  // Curves that coincide stay visible: the earlier ones are drawn wider and below.
  const width = (index) => Math.max(2.1 - 0.5 * index, 1);

  const line = (name, colour, width) => ({
    type: "scatter",
    mode: "lines",
    name: safe(name),
    line: { color: colour, width },
    hoverlabel: { namelength: -1 },
  });
  const shown = () =>
    model()
      .variants.map((name, i) => [name, i])
      .filter(([name]) => !hiddenVariants.has(name));

  // -- figures ----------------------------------------------------------------------------------

  // Curves' colours have six hexadecimal digits; two more give the opacity.
  const tint = (colour) => colour + "30";

  // The verdict: one row per signal, one mark per variant, where it falls among the grades.
  const FAR = 1.2;
  const brief = (name) => {
    const most = narrow.matches ? 14 : 24;
    return safe(name.length > most ? name.slice(0, most - 1) + "…" : name);
  };

  function drawVerdict() {
    const { channels, nrmse, completed, limits } = model().scores;
    const traces = shown().map(([name, i]) => {
      const values = nrmse[name].map((v) => (v === null && !completed[name] ? FAR : v));
      const told = nrmse[name].map((v) => (v === null ? "ended early" : v.toPrecision(2)));
      return {
        type: "scatter",
        mode: "markers",
        name: safe(name),
        x: values.map((v) => (v === null ? null : Math.min(v, FAR))),
        y: channels.map((_, k) => k),
        customdata: told,
        marker: {
          color: curve(i),
          size: 10,
          symbol: values.map((v) => (v >= FAR ? "triangle-right" : "circle")),
          line: { color: css("--paper"), width: 1 },
        },
        hovertemplate: "%{customdata}",
      };
    });
    const layout = base(92 + 30 * channels.length, 44, 40);
    const ends = [0, ...limits, FAR * 1.04];
    const words = ["usable", narrow.matches ? "trends" : "for trends only", "not usable"];
    words.forEach((word, k) => {
      layout.shapes.push({
        type: "rect",
        layer: "below",
        xref: "x",
        yref: "paper",
        x0: ends[k],
        x1: ends[k + 1],
        y0: 0,
        y1: 1,
        fillcolor: css(`--grade-${k + 1}`),
        line: { width: 0 },
      });
      layout.annotations.push({
        text: word,
        x: (ends[k] + ends[k + 1]) / 2,
        y: 1,
        xref: "x",
        yref: "paper",
        yanchor: "bottom",
        showarrow: false,
        font: { size: 11, color: css("--soft") },
      });
    });
    layout.xaxis = axis({
      title: {
        text: narrow.matches ? "mean NRMSE" : "error / spread of the record (mean NRMSE)",
        standoff: 4,
        font: { size: 12 },
      },
      range: [0, FAR * 1.04],
    });
    layout.yaxis = axis({
      tickvals: channels.map((_, k) => k),
      ticktext: channels.map(brief),
      range: [channels.length - 0.5, -0.5],
      automargin: true,
      zeroline: false,
    });
    layout.hovermode = "closest";
    const entries = shown().map(([name, i]) => {
      const [entry, mark] = [node("span", "", "band"), node("span", "", "dot")];
      mark.style.background = curve(i);
      entry.append(mark, name);
      return entry;
    });
    byId("verdict-key").replaceChildren(...entries.flatMap((e) => [e, " "]));
    draw("verdict-plot", traces, layout);
  }

  function drawSeries() {
    const r = run();
    const banded = model().variants.findIndex((name) => r.variants[name].band);
    for (const patch of document.querySelectorAll(".patch.interval")) {
      patch.style.background = banded < 0 ? "none" : tint(curve(banded));
    }
    const list = model().channels.map((channel, c) => {
      const range = r.ranges[c];
      const at = (s, name, colour, width) => ({
        ...line(name, colour, width),
        y: array(s.y[c]),
        x0: s.t0,
        dx: s.dt * s.every[c],
        hovertemplate: "%{y:.5~g}",
      });
      const traces = [];
      for (const [name, i] of shown()) traces.push(...shade(r.variants[name], c, curve(i)));
      traces.push(at(r.recorded, "recorded", css("--recorded"), 1.6));
      for (const [name, i] of shown()) {
        const s = r.variants[name];
        traces.push(at(s, name, curve(i), width(i)));
        if (s.ended !== null) traces.push(ending(s, name, c, range, curve(i)));
      }
      return { label: labelled(channel.name, channel.unit), traces, range, x: "time (s)" };
    });
    panels("series-plot", list, { shared: true, height: 120, range: window_() });
    const notes = shown()
      .filter(([name]) => r.variants[name].ended !== null)
      .map(([name, i]) => {
        const s = r.variants[name];
        const [item, mark] = [node("li"), node("b", "× ")];
        mark.style.color = curve(i);
        item.append(mark, `${name} ended at ${short(s.ended)} s: ${s.message}`);
        return item;
      });
    byId("endings").replaceChildren(...notes);
  }

  // Prediction intervals around a rollout; drawn first, so they lie below all curves.
  function shade(s, c, colour) {
    if (!s.band) return [];
    const [y, half] = [array(s.y[c]), array(s.band.y[c])];
    const [step, wide] = [s.dt * s.every[c], s.band.dt * s.band.every[c]];
    const at = (k) => half[Math.min(Math.round((k * step) / wide), half.length - 1)];
    return [-1, 1].map((side, n) => ({
      type: "scatter",
      mode: "lines",
      y: y.map((v, k) => v + side * at(k)),
      x0: s.t0,
      dx: step,
      line: { width: 0 },
      fill: n ? "tonexty" : "none",
      fillcolor: tint(colour),
      hoverinfo: "skip",
    }));
  }

  // The last point of a rollout may lie far outside the panel; its mark stays inside.
  function ending(s, name, c, range, colour) {
    const margin = 0.04 * (range[1] - range[0]);
    const y = Math.min(Math.max(s.last[c], range[0] + margin), range[1] - margin);
    return {
      type: "scatter",
      mode: "markers",
      x: [s.ended],
      y: [y],
      name: safe(name),
      marker: { symbol: "x", size: 9, color: colour, line: { color: css("--paper"), width: 1 } },
      hovertemplate: "ended",
    };
  }

  function drawSpectra() {
    const r = run();
    const bands = r.bands.map((b, i) => [b.low, b.high, css(`--band-${(i % 3) + 1}`)]);
    const list = model().channels.map((channel, c) => {
      const at = (s, name, colour, width) => ({
        ...line(name, colour, width),
        y: array(s.psd[c]),
        x0: 0,
        dx: s.df,
        hovertemplate: "%{y:.3~g}",
      });
      const traces = [at(r.recorded, "recorded", css("--recorded"), 1.8)];
      for (const [name, i] of shown()) {
        if (r.variants[name].psd) traces.push(at(r.variants[name], name, curve(i), width(i)));
      }
      return {
        label: labelled(channel.name, squared(channel.unit)),
        traces,
        log: true,
        bands,
        x: "frequency (Hz)",
      };
    });
    panels("spectra-plot", list, { height: 170, range: [0, 1], matches: true });
    const legend = [node("span", "Shaded:")];
    r.bands.forEach((b, i) => {
      const patch = node("span", "", "patch");
      patch.style.background = css(`--band-${(i % 3) + 1}`);
      const item = node("span", "", "band");
      item.append(patch, `${b.name} ${b.low.toPrecision(2)}–${b.high.toPrecision(2)} Hz`);
      legend.push(item, " ");
    });
    const unfinished = shown().filter(([name]) => !r.variants[name].psd);
    if (unfinished.length) {
      const names = unfinished.map(([name]) => name).join(", ");
      legend.push(node("span", `Not drawn, rollout unfinished: ${names}.`));
    }
    byId("bands").replaceChildren(...legend);
  }

  function drawErrors() {
    const m = model();
    const list = [];
    m.histograms.forEach((h, c) => {
      if (!h) return;
      const { name, unit } = m.channels[c];
      // A variant that completed no run has no errors to count.
      const counted = shown().filter(([variant]) => variant in h.share);
      const traces = counted.map(([variant, i]) => ({
        ...line(variant, curve(i), width(i)),
        line: { color: curve(i), width: width(i), shape: "hvh" },
        x: array(h.x),
        y: array(h.share[variant]),
        hovertemplate: "%{y:.2f}",
      }));
      list.push({ label: labelled(name), traces, x: unit ? `error (${unit})` : "error" });
    });
    if (!list.length) {
      nothing("errors-plot", "The variants have no completed test run in common, so there is nothing to compare.");
      return;
    }
    clear("errors-plot");
    panels("errors-plot", list, { height: 150, suffix: " %" });
  }

  function drawEigenvalues() {
    const m = model();
    const points = [];
    for (const e of m.eigenvalues) {
      e.real.forEach((x, i) => points.push({ x, y: e.imag[i], s: e.schedule }));
    }
    const many = m.schedule !== null && m.eigenvalues.length > 1;
    const trace = (unstable, name, symbol) => {
      const some = points.filter((p) => p.x > 0 === unstable);
      const colour = unstable ? css("--bad") : css("--curve-1");
      return {
        type: "scatter",
        mode: "markers",
        name,
        x: some.map((p) => p.x),
        y: some.map((p) => p.y),
        customdata: some.map((p) => p.s),
        marker: { symbol, size: unstable ? 9 : 8, color: colour, line: { width: 1.5, color: colour } },
        hovertemplate:
          "%{x:.4~g} 1/s, %{y:.4~g} rad/s" + (many ? "<br>schedule %{customdata:.4~g}" : ""),
      };
    };
    const layout = base(370, 56, 46);
    layout.margin.l = 58;
    layout.xaxis = axis({ title: { text: "real part (1/s)", standoff: 4 } });
    layout.yaxis = axis({ title: { text: "imaginary part (rad/s)", standoff: 4 } });
    layout.hovermode = "closest";
    layout.showlegend = true;
    layout.legend = { orientation: "h", x: 0, y: 1.02, yanchor: "bottom" };
    layout.shapes.push({
      type: "line",
      xref: "x",
      yref: "paper",
      x0: 0,
      x1: 0,
      y0: 0,
      y1: 1,
      line: { color: css("--soft"), width: 1, dash: "dot" },
    });
    const traces = [trace(false, "stable", "circle-open"), trace(true, "unstable", "x-thin")];
    draw("eigenvalues-plot", traces.filter((t) => t.x.length), layout);
  }

  // -- selection --------------------------------------------------------------------------------

  function window_() {
    const r = run();
    const value = (input, fallback) => (input.value === "" ? fallback : Number(input.value));
    const [from, to] = [value(span.from, r.start), value(span.to, r.stop)];
    return from < to ? [from, to] : [r.start, r.stop];
  }

  function fill(select, names) {
    const before = select.value;
    select.replaceChildren(
      ...names.map((name, i) => {
        const option = node("option", name);
        option.value = String(i);
        return option;
      }),
    );
    if (before !== "" && Number(before) < names.length) select.value = before;
  }

  function fillVariants() {
    const place = byId("pick-variants");
    const swatch = (colour) => {
      const made = node("span", "", "swatch");
      made.style.borderTopColor = colour;
      return made;
    };
    const reference = node("label");
    reference.append(swatch(css("--recorded")), node("span", "recorded"));
    const boxes = model().variants.map((name, i) => {
      const label = node("label");
      const box = node("input");
      box.type = "checkbox";
      box.checked = !hiddenVariants.has(name);
      box.addEventListener("change", () => {
        if (box.checked) hiddenVariants.delete(name);
        else hiddenVariants.add(name);
        redraw();
      });
      label.append(box, swatch(curve(i)), node("span", name));
      return label;
    });
    place.replaceChildren(place.querySelector("legend"), reference, ...boxes);
  }

  function showTables() {
    const [m, r] = [picks.model.value, picks.run.value];
    for (const part of document.querySelectorAll("[data-model]")) {
      const { model: ofModel, run: ofRun } = part.dataset;
      part.hidden = ofModel !== m || (ofRun !== undefined && ofRun !== r);
    }
    const perRun = new Set(["series-plot", "spectra-plot"]);
    for (const figure of document.querySelectorAll("figure")) {
      const parts = [model().name];
      if (perRun.has(figure.querySelector(".plot").id)) parts.push(run().name);
      figure.querySelector(".context").textContent = parts.join(", ");
    }
  }

  function redraw() {
    drawVerdict();
    drawSeries();
    drawSpectra();
    drawErrors();
    drawEigenvalues();
  }

  function select() {
    fill(picks.run, model().runs.map((r) => r.name));
    fillVariants();
    showTables();
    span.from.placeholder = short(run().start);
    span.to.placeholder = short(run().stop);
    redraw();
  }

  function restyle() {
    fillVariants();
    redraw();
  }

  // Print in light colours and at the width of a page, whatever the screen shows.
  function print(on) {
    document.documentElement.classList.toggle("printing", on);
    restyle();
    for (const plot of document.querySelectorAll(".js-plotly-plot")) {
      window.Plotly.relayout(plot, on ? { width: 680 } : { width: null, autosize: true });
    }
  }

  fill(picks.model, data.models.map((m) => m.name));
  picks.model.addEventListener("change", select);
  picks.run.addEventListener("change", select);
  for (const input of [span.from, span.to]) {
    input.addEventListener("change", () =>
      window.Plotly.relayout(byId("series-plot"), { "xaxis.range": window_() }),
    );
  }
  byId("whole").addEventListener("click", () => {
    span.from.value = span.to.value = "";
    drawSeries();
  });
  byId("controls").addEventListener("submit", (event) => event.preventDefault());
  byId("controls").hidden = false;
  narrow.addEventListener("change", redraw);
  dark.addEventListener("change", restyle);
  window.addEventListener("beforeprint", () => print(true));
  window.addEventListener("afterprint", () => print(false));
  select();
})();
