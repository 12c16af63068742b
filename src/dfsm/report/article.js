// Draws the panels of an article's figures. Names and titles are data: Plotly, which reads tags in
// texts, gets them escaped.
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const coarse = window.matchMedia("(pointer: coarse)");
  const HEIGHT = 235;
  // Panels that stand above each other are lower, and only the last names their common axis.
  const STACKED = 132;

  const safe = (text) =>
    String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");
  const array = (index) => unpack(data.blobs, index);
  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const colour = (index) => css(index === 0 ? "--recorded" : `--curve-${((index - 1) % 5) + 1}`);

  function trace(curve) {
    const made = {
      type: "scatter",
      name: safe(curve.name),
      x: array(curve.x),
      y: array(curve.y),
      mode: curve.style === "points" ? "markers" : "lines",
      hovertemplate: "%{y:.4~g}",
    };
    const paint = colour(curve.colour);
    if (curve.style === "points") {
      made.marker = { color: "rgba(0,0,0,0)", size: 8, line: { color: paint, width: 2 } };
      return made;
    }
    made.line = {
      color: paint,
      // The truth stays visible under what agrees with it.
      width: curve.colour === 0 && curve.style === "line" ? 2.6 : 1.5,
      dash: curve.style === "dashed" ? "6px,4px" : "solid",
      shape: curve.style === "steps" ? "hvh" : "linear",
    };
    return made;
  }

  function axis(title, log, extra) {
    return {
      title: { text: safe(title), standoff: 5, font: { size: 12 } },
      type: log ? "log" : "linear",
      exponentformat: log ? "power" : "SI",
      minexponent: 4,
      nticks: 6,
      minor: log ? { nticks: 10, showgrid: false } : undefined,
      // Plotly enlarges powers of ten by a quarter.
      tickfont: { color: css("--soft"), size: log ? 9.5 : 11 },
      gridcolor: css("--faint"),
      linecolor: css("--rule"),
      zerolinecolor: css("--rule"),
      tickcolor: css("--rule"),
      showline: true,
      ticks: "outside",
      ticklen: 3,
      automargin: true,
      // Powers of ten only: what lies between is clear from them.
      dtick: log ? 1 : undefined,
      ...extra,
    };
  }

  function layout(panel, stacked, last) {
    const labels = (ticks) =>
      ticks.length
        ? {
            tickmode: "array",
            tickvals: ticks.map((t) => t[0]),
            ticktext: ticks.map((t) => safe(t[1])),
            tickfont: { color: css("--soft"), size: 11 },
          }
        : {};
    const range = panel.range
      ? { range: panel.log.includes("y") ? panel.range.map(Math.log10) : panel.range }
      : {};
    return {
      height: stacked ? STACKED + (last ? 20 : 0) : HEIGHT,
      margin: stacked ? { l: 62, r: 8, t: 6, b: last ? 38 : 18 } : { l: 44, r: 8, t: 8, b: 38 },
      paper_bgcolor: "rgba(0,0,0,0)",
      plot_bgcolor: "rgba(0,0,0,0)",
      font: { family: getComputedStyle(document.body).fontFamily, size: 12, color: css("--ink") },
      hoverlabel: { bgcolor: css("--panel"), bordercolor: css("--rule"), namelength: -1 },
      hovermode: panel.ticks.length ? "closest" : "x unified",
      showlegend: false,
      dragmode: coarse.matches ? false : "zoom",
      xaxis: axis(stacked && !last ? "" : panel.x, panel.log.includes("x"), {
        ...labels(panel.x_ticks),
        ...(panel.x_range ? { range: panel.x_range } : {}),
        ...(stacked ? { automargin: false } : {}),
      }),
      yaxis: axis(panel.y, panel.log.includes("y"), {
        ...labels(panel.ticks),
        ...range,
        // Equal margins keep stacked axes in line.
        ...(stacked ? { automargin: false, nticks: 4 } : {}),
      }),
    };
  }

  // Zooming one of several stacked panels zooms all.
  function link(places) {
    let busy = false;
    for (const place of places) {
      if (place.linked) continue;
      place.linked = true;
      place.on("plotly_relayout", (change) => {
        if (busy || !Object.keys(change).some((key) => key.startsWith("xaxis."))) return;
        busy = true;
        const { range, autorange } = place.layout.xaxis;
        const wanted = autorange ? { "xaxis.autorange": true } : { "xaxis.range": [...range] };
        const others = [...places].filter((other) => other !== place);
        Promise.all(others.map((other) => window.Plotly.relayout(other, wanted))).finally(() => {
          busy = false;
        });
      });
    }
  }

  function redraw() {
    for (const mark of document.querySelectorAll("[data-colour]")) {
      mark.style.borderColor = colour(Number(mark.dataset.colour));
    }
    for (const [key, panels] of Object.entries(data.figures)) {
      const figure = document.getElementById(key);
      const places = figure.querySelectorAll(".plot");
      const stacked = figure.querySelector(".stacked") !== null;
      panels.forEach((panel, i) => {
        const last = i === panels.length - 1;
        window.Plotly.react(places[i], panel.curves.map(trace), layout(panel, stacked, last), {
          responsive: true,
          displayModeBar: false,
          doubleClick: "reset",
        });
      });
      if (stacked) link(places);
    }
  }

  // Print in light colours and at the width of half a page, whatever the screen shows.
  function print(on) {
    document.documentElement.classList.toggle("printing", on);
    redraw();
    for (const plot of document.querySelectorAll(".js-plotly-plot")) {
      window.Plotly.relayout(plot, on ? { width: 330 } : { width: null, autosize: true });
    }
  }

  dark.addEventListener("change", redraw);
  window.addEventListener("beforeprint", () => print(true));
  window.addEventListener("afterprint", () => print(false));
  redraw();
})();
