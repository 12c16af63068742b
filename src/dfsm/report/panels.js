// Stacked panels of one figure, and what every figure of a page shares.
// Names and units are data: the page gets them as text, Plotly (which reads tags in texts) escaped.
"use strict";
const panel = (() => {
  const byId = (id) => document.getElementById(id);
  const narrow = window.matchMedia("(max-width: 700px)");
  const coarse = window.matchMedia("(pointer: coarse)");
  const safe = (text) =>
    String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");
  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  function node(tag, text, className) {
    const made = document.createElement(tag);
    if (text !== undefined) made.textContent = text;
    if (className) made.className = className;
    return made;
  }

  // -- stacked panels ---------------------------------------------------------------------------

  // In px; the mode bar has the head to itself, panel labels stand in the gaps.
  const GAP = { head: 50, top: 26, between: 46, shared: 30, bottom: 44 };

  // One figure of panels, {label, traces, range, log, bands, x}; a shared x-axis is drawn once.
  function panels(id, list, options) {
    const columns = options.shared || narrow.matches ? 1 : Math.min(2, list.length);
    const rows = Math.ceil(list.length / columns);
    const gap = options.shared ? GAP.shared : GAP.between + GAP.top;
    const inner = rows * options.height + (rows - 1) * gap;
    const layout = base(inner + GAP.head + GAP.bottom, GAP.head, GAP.bottom);
    const traces = [];
    list.forEach((panel, k) => {
      const [row, column] = [Math.floor(k / columns), k % columns];
      const top = 1 - (row * (options.height + gap)) / inner;
      const n = k === 0 ? "" : String(k + 1);
      const xn = options.shared ? "" : n;
      const left = column / columns + (column ? 0.04 : 0);
      const right = (column + 1) / columns - (columns > 1 && !column ? 0.04 : 0);
      const low = Math.max(0, top - options.height / inner);
      layout["yaxis" + n] = axis({
        domain: [low, top],
        anchor: "x" + xn,
        type: panel.log ? "log" : "linear",
        range: panel.range,
        nticks: panel.log ? 5 : 4,
        exponentformat: panel.log ? "power" : "SI",
        // Plotly enlarges powers of ten by a quarter.
        tickfont: { color: css("--soft"), size: panel.log ? 9 : 11 },
        ticksuffix: options.suffix || "",
      });
      if (!options.shared || k === 0) {
        layout["xaxis" + xn] = axis({
          domain: [left, right],
          anchor: "y" + (options.shared && list.length > 1 ? list.length : n),
          title: { text: safe(panel.x), standoff: 4, font: { size: 12 } },
          range: options.range,
          matches: options.matches && k > 0 ? "x" : undefined,
          nticks: narrow.matches ? 6 : undefined,
        });
      }
      layout.annotations.push({
        text: panel.label,
        xref: "paper",
        yref: "paper",
        x: left,
        y: top,
        xanchor: "left",
        yanchor: "bottom",
        showarrow: false,
        font: { size: 12.5, color: css("--ink") },
      });
      for (const [low_, high, colour] of panel.bands || []) {
        layout.shapes.push({
          type: "rect",
          layer: "below",
          xref: "x" + xn,
          yref: `y${n} domain`,
          x0: low_,
          x1: high,
          y0: 0,
          y1: 1,
          fillcolor: colour,
          line: { width: 0 },
        });
      }
      for (const t of panel.traces) traces.push({ ...t, xaxis: "x" + xn, yaxis: "y" + n });
    });
    layout.hovermode = "x unified";
    return draw(id, traces, layout);
  }

  function base(height, top, bottom) {
    return {
      height,
      margin: { l: narrow.matches ? 46 : 58, r: 10, t: top, b: bottom },
      paper_bgcolor: "rgba(0,0,0,0)",
      plot_bgcolor: "rgba(0,0,0,0)",
      font: { family: getComputedStyle(document.body).fontFamily, size: 12, color: css("--ink") },
      hoverlabel: { bgcolor: css("--panel"), bordercolor: css("--rule"), namelength: -1 },
      modebar: {
        bgcolor: "rgba(0,0,0,0)",
        color: css("--soft"),
        activecolor: css("--ink"),
      },
      showlegend: false,
      dragmode: coarse.matches ? false : "zoom",
      annotations: [],
      shapes: [],
    };
  }

  function axis(extra) {
    return {
      gridcolor: css("--faint"),
      linecolor: css("--rule"),
      zerolinecolor: css("--rule"),
      tickcolor: css("--rule"),
      tickfont: { color: css("--soft"), size: 11 },
      showline: true,
      ticks: "outside",
      ticklen: 3,
      ...extra,
    };
  }

  function draw(id, traces, layout) {
    return window.Plotly.react(byId(id), traces, layout, {
      responsive: true,
      displaylogo: false,
      doubleClick: "reset",
      modeBarButtons: [["toImage", "zoom2d", "pan2d", "zoomIn2d", "zoomOut2d", "resetScale2d"]],
    });
  }

  function nothing(id, text) {
    const place = byId(id);
    if (window.Plotly && place.classList.contains("js-plotly-plot")) window.Plotly.purge(place);
    place.replaceChildren(node("p", text, "note"));
  }

  function clear(id) {
    const place = byId(id);
    if (!place.classList.contains("js-plotly-plot")) place.replaceChildren();
  }

  return { axis, base, byId, clear, css, draw, narrow, node, nothing, panels, safe };
})();
