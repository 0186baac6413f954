// The chart of a sweep: each run as a dot, means over recordings with 95 % intervals as lines.
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const columns = new Map([...data.settings, ...data.metrics].map((c) => [c.name, c]));
for (const metric of data.metrics.filter((m) => m.name.startsWith("answer_"))) {
  const name = metric.name.slice("answer_".length);
  const [online, revised] = [name, `revised_${name}`].map((path) => columns.get(path)?.values ?? []);
  metric.values = data.revised.map((is, row) => (is ? revised : online)[row] ?? null);
}
const byId = (id) => document.getElementById(id);
const COLOURS = ["#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#8c8c8c",
  "#AA3377", "#999933", "#7766dd", "#b0724a", "#44aa99"];
const MARKERS = ["circle", "square", "diamond", "triangle-up", "triangle-down", "cross", "x",
  "triangle-left", "triangle-right", "star", "hexagon", "pentagon"];
const kept = new Map(); // values to keep, by the setting

function fill(select, options, chosen) {
  for (const [value, text] of options) select.append(new Option(text, value));
  select.value = chosen;
  select.addEventListener("change", draw);
}

const ALL = data.failed.map((_, row) => row);

function distinct(name, rows = ALL) {
  const column = columns.get(name).values;
  const values = [...new Set(rows.map((row) => column[row]).filter((v) => v !== null))];
  return values.sort((a, b) => (typeof a === "number" ? a - b : String(a).localeCompare(b)));
}

// Numbers of a column as plots have them: all with powers of ten if one needs it.
function writer(values) {
  const powers = values.some((v) => typeof v === "number" && v && (Math.abs(v) < 1e-4 || Math.abs(v) >= 1e6));
  return (v) => (powers && typeof v === "number" && v ? v.toExponential().replace("e+", "e") : String(v));
}
const writers = new Map(data.settings.map((s) => [s.name, writer(s.values)]));
const word = (name, value) => writers.get(name)(value);

// What tells a run from others.
const named = (row) => data.settings
  .filter((s) => s.values[row] !== null && new Set(s.values).size > 1)
  .map((s) => `${s.title}: ${word(s.name, s.values[row])}`);

function setUp() {
  const settings = data.settings.map((c) => [c.name, c.title]);
  const few = [["", "none"], ...settings.filter(([name]) => distinct(name).length <= 12)];
  fill(byId("x"), settings, data.start.x);
  fill(byId("y"), data.metrics.map((c) => [c.name, c.title]), data.start.y);
  fill(byId("colour"), few, data.start.colour);
  fill(byId("panels"), few, data.start.panels);
  byId("each").addEventListener("change", draw);
  for (const [name, title] of settings) {
    const values = distinct(name);
    if (values.length < 2 || values.length > 24) continue;
    kept.set(name, new Set(values));
    const box = document.createElement("details");
    const summary = document.createElement("summary");
    summary.textContent = `only some of ${title}`;
    box.append(summary);
    for (const value of values) {
      const label = document.createElement("label");
      const input = document.createElement("input");
      input.type = "checkbox";
      input.checked = true;
      input.addEventListener("change", () => {
        kept.get(name)[input.checked ? "add" : "delete"](value);
        draw();
      });
      label.append(input, ` ${word(name, value)}`);
      box.append(label);
    }
    byId("filters").append(box);
  }
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  addEventListener("resize", draw);
  draw();
}

// Rows in groups by a key, in the order of the rows.
function grouped(rows, key) {
  const groups = new Map();
  for (const row of rows) {
    const name = key(row);
    if (!groups.has(name)) groups.set(name, []);
    groups.get(name).push(row);
  }
  return groups;
}

// Ticks of a logarithmic axis that spans little.
const NUMBERS = Array.from({ length: 36 }, (_, i) => [1, 2, 5].map((m) => Number(`${m}e${i - 18}`))).flat();

// Where values stand on the x axis: each colour a little beside the others, as in plots.
function placed(order, beside, n, { numeric, joined, wide }) {
  const [low, high] = [order[0], order[order.length - 1]];
  if (wide) return (v) => v * (high / low) ** (0.006 * beside);
  if (joined) return (v) => v + 0.006 * (high - low) * beside;
  const apart = numeric ? Math.min(high - low, ...order.slice(1).map((v, i) => v - order[i])) : 1;
  const shift = apart * Math.min(0.12, 0.7 / n) * beside;
  return (v) => (numeric ? v : order.indexOf(v)) + shift;
}

// A text of a file as Plotly's labels show it, which read some of HTML.
const safe = (text) => String(text).replaceAll("&", "&amp;").replaceAll("<", "&lt;").replaceAll(">", "&gt;");

const mean = (values) => values.reduce((sum, v) => sum + v, 0) / values.length;

// Mean with its 95 % interval, if it is of three or more: the rule of tables and plots.
// Repeats are runs of one recording that are equal in the `others`.
function average(rows, metric, unit, others) {
  const logs = metric.average !== "plain";
  const [into, back] = logs ? [Math.log, Math.exp] : [(v) => v, (v) => v];
  const of = (repeats) => {
    const values = repeats.map((row) => metric.values[row]);
    return metric.average === "error" ? Math.sqrt(mean(values.map((v) => v * v))) : mean(values);
  };
  const setting = (row) => others.map((s) => s.values[row]).join("\u0000");
  const values = [...grouped(rows, (row) => unit[row]).values()].map((same) =>
    mean([...grouped(same, setting).values()].map((repeats) => into(of(repeats)))));
  const middle = mean(values);
  const n = values.length;
  const spread = Math.sqrt(values.reduce((sum, v) => sum + (v - middle) ** 2, 0) / (n - 1));
  const t = data.t975[Math.min(n - 1, data.t975.length) - 1];
  const half = n > 2 ? (t * spread) / Math.sqrt(n) : NaN;
  const least = metric.values.every((v) => v === null || v >= 0) ? 0 : -Infinity;
  const round = (v) => Number(v.toPrecision(6)); // else a mean of one is not quite its run
  return { value: round(back(middle)), low: round(Math.max(least, back(middle - half))),
    high: round(back(middle + half)), n };
}

// Numbers that grow by factors rather than by steps.
function byFactors(values) {
  const numbers = values.filter((v) => typeof v === "number");
  if (numbers.length < 2 || numbers.length < values.length || numbers[0] <= 0) return false;
  const [low, high] = [numbers[0], numbers[numbers.length - 1]];
  if (numbers.length === 2) return high >= 10 * low;
  const even = (list) => {
    const steps = list.slice(1).map((v, i) => v - list[i]);
    const middle = mean(steps);
    return mean(steps.map((v) => (v - middle) ** 2)) / middle ** 2;
  };
  return high >= 3 * low && even(numbers.map(Math.log)) < even(numbers);
}

function draw() {
  const [x, y, colour, panels] = ["x", "y", "colour", "panels"].map((id) => byId(id).value);
  const [xs, metric] = [columns.get(x), columns.get(y)];
  const chosen = ALL.filter((row) =>
    [...kept].every(([name, some]) => {
      const value = columns.get(name).values[row];
      return value === null || some.has(value);
    }));
  const ended = chosen.filter((row) => !data.failed[row]);
  const rows = ended.filter((row) => metric.values[row] !== null && xs.values[row] !== null);
  const missing = [[chosen.length - ended.length, "failed"], [ended.length - rows.length, "have no finite value"]];
  const left = missing.filter(([n]) => n).map(([n, why]) => `${n} ${n === 1 ? why.replace("have", "has") : why}`);
  const not = left.length ? ` Not drawn: ${left.join(", ")}.` : "";
  byId("chart").hidden = !rows.length;
  if (!rows.length) {
    const none = { visible: false };
    Plotly.react("chart", [], { height: 60, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      margin: { t: 0, b: 0 }, xaxis: none, yaxis: none }, { displayModeBar: false });
    byId("said").textContent = chosen.length ? `0 runs.${not}` : "Nothing is chosen.";
    return;
  }
  const style = getComputedStyle(document.documentElement);
  const ink = style.getPropertyValue("--text").trim();
  const line = style.getPropertyValue("--line").trim();
  const order = distinct(x, rows);
  const numeric = order.every((v) => typeof v === "number");
  const of = (name, row) => (name ? columns.get(name).values[row] : "");
  const joined = numeric && !["repeat", ...data.drawn].includes(x); // seeds have no order
  const wide = joined && byFactors(order);
  const panelNames = panels ? distinct(panels, rows) : [""];
  const colours = colour ? distinct(colour) : [""];
  const groups = grouped(rows, (row) => [of(panels, row), of(colour, row), of(x, row)].join("\u0000"));
  const alone = [...groups.values()].every((g) => new Set(g.map((r) => data.recording[r])).size === 1);
  const repeated = alone && [...groups.values()].some((g) => new Set(g.map((r) => data.repeat[r])).size > 1);
  const unit = repeated ? data.repeat : data.recording;
  const others = data.settings.filter((s) => ![x, colour, panels, "repeat", ...data.drawn].includes(s.name) &&
    distinct(s.name, rows).length > 1);
  const narrow = matchMedia("(max-width: 700px)").matches;
  // where means have bars, their runs' dots stand to the left of them
  const aside = numeric || [...groups.values()].every((g) => g.length === 1) ? 0 : -0.4;
  const across = Math.min(panelNames.length, narrow ? 1 : 3);
  const down = Math.ceil(panelNames.length / across);
  const traces = [];
  const found = [];
  const annotations = [];
  panelNames.forEach((panel, p) => {
    const axis = p ? String(p + 1) : "";
    const inPanel = rows.filter((row) => !panels || of(panels, row) === panel);
    if (panels) {
      annotations.push({ text: safe(`${columns.get(panels).title}: ${word(panels, panel)}`),
        showarrow: false, xref: `x${axis} domain`, yref: `y${axis} domain`, x: 0.5, y: 1.02,
        yanchor: "bottom" });
    }
    colours.forEach((name, c) => {
      const mine = inPanel.filter((row) => !colour || of(colour, row) === name);
      if (!mine.length) return;
      const label = colour ? safe(word(colour, name)) : "";
      const shared = { xaxis: `x${axis}`, yaxis: `y${axis}`, legendgroup: label, name: label };
      const beside = (shift) =>
        placed(order, c - (colours.length - 1) / 2 + shift, colours.length, { numeric, joined, wide });
      const at = beside(0);
      const paint = COLOURS[c % COLOURS.length];
      if (byId("each").checked) {
        traces.push({ ...shared, type: "scatter", mode: "markers", showlegend: false,
          x: mine.map((row) => beside(aside)(of(x, row))), y: mine.map((row) => metric.values[row]),
          marker: { color: paint, size: 6, opacity: 0.45 }, customdata: mine,
          text: mine.map((row) => [...named(row), data.statuses[data.status[row]]].map(safe).join("<br>")),
          hovertemplate: "%{y:.4g}<br>%{text}<extra></extra>" });
      }
      const points = order.map((v) => [v, mine.filter((row) => of(x, row) === v)])
        .filter(([, some]) => some.length).map(([v, some]) => ({ at: at(v),
          row: some.length === 1 ? some[0] : undefined, ...average(some, metric, unit, others) }));
      found.push(...points);
      traces.push({ ...shared, type: "scatter", mode: joined ? "lines+markers" : "markers",
        showlegend: Boolean(colour) && !traces.some((t) => t.name === label && t.showlegend),
        x: points.map((point) => point.at), y: points.map((point) => point.value),
        marker: { color: paint, symbol: MARKERS[c % MARKERS.length], size: 9 },
        line: { color: paint, width: 2 },
        error_y: { type: "data", symmetric: false, color: paint, thickness: 1.5,
          array: points.map((point) => point.high - point.value || 0),
          arrayminus: points.map((point) => point.value - point.low || 0) },
        customdata: points.map((point) => [point.low, point.high, point.n, point.row]),
        hovertemplate: points.map((point) => "<b>%{y:.4g}</b>"
          + (point.n > 2 ? " [%{customdata[0]:.3g}, %{customdata[1]:.3g}]" : "")
          + (point.n > 1 ? ", mean of %{customdata[2]}" : "") + "<extra>%{fullData.name}</extra>") });
    });
  });
  const means = found.map((point) => point.value).sort((a, b) => a - b);
  const log = metric.log && means[0] > 0 && means[means.length - 1] >= 10 * means[0];
  const shown = rows.map((row) => metric.values[row]);
  const level = shown.every((v) => v === shown[0]);
  const decades = means[means.length - 1] / means[0];
  const legend = 25 * colours.length;
  const height = narrow ? Math.max(420, 330 * down) + legend
    : Math.max(420, 330 * down, 180 + legend);
  // where a narrow legend begins: below the ticks, whose words are slanted, and the axis' title
  const below = 70 + (numeric ? 0 : 3.5 * Math.max(...order.map((v) => word(x, v).length)));
  const layout = {
    height, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    font: { color: ink, family: "system-ui, sans-serif", size: 13 }, annotations,
    margin: { l: 70, r: 15, t: 50, b: 60 }, hovermode: "closest",
    modebar: { bgcolor: "rgba(0,0,0,0)", color: ink, activecolor: ink },
    hoverlabel: { namelength: -1 },
    legend: narrow ? { orientation: "h", y: -below / (height - 110 - legend), yanchor: "top" }
      : { title: { text: colour ? safe(columns.get(colour).title) : "" } },
    grid: { rows: down, columns: across, pattern: "independent", xgap: 0.12, ygap: 0.3 },
  };
  panelNames.forEach((_, p) => {
    const axis = p ? String(p + 1) : "";
    const lines = { gridcolor: line, linecolor: line, zerolinecolor: line, automargin: true };
    layout[`xaxis${axis}`] = { ...lines, title: { text: p >= panelNames.length - across ? safe(xs.title) : "" },
      ...(numeric ? { type: wide ? "log" : "linear",
        ...(order.length <= 8 ? { tickvals: order, ticktext: order.map((v) => word(x, v)) } : {}) }
        : { type: "linear", tickvals: order.map((_, i) => i), ticktext: order.map((v) => safe(word(x, v))),
          ...(order.length + panelNames.length === 2 ? { range: [-0.5, 0.5] } : {}),
          zeroline: false, ticklabeloverflow: "allow", tickangle: narrow ? -30 : "auto" }),
      ...(p ? { matches: "x" } : {}) };
    layout[`yaxis${axis}`] = { ...lines, title: { text: p % across ? "" : safe(metric.title) },
      type: log ? "log" : "linear", ...(log && decades >= 100 ? { dtick: 1 } : {}),
      ...(log && decades < 100 ? { tickvals: NUMBERS, ticktext: NUMBERS.map(writer(means)) } : {}),
      exponentformat: "power", rangemode: level ? "tozero" : "normal", ...(p ? { matches: "y" } : {}) };
  });
  Plotly.react("chart", traces, layout,
    { responsive: true, displaylogo: false, modeBarButtons: [["toImage", "zoom2d", "pan2d", "resetScale2d"]] });
  say(rows, not, metric, repeated, found.map((point) => point.n > 2), others);
}

// Say how the means came about, what is not drawn, and what else differs within a point.
function say(rows, not, metric, repeated, bounded, others) {
  const over = repeated ? "repeats" : "recordings";
  const kind = metric.average === "plain" ? "Arithmetic" : "Geometric";
  const pooledBy = metric.average === "error" && !repeated ? ", repeats pooled by squares" : "";
  const intervals = bounded.every(Boolean) ? ", with 95 % intervals"
    : bounded.some(Boolean) ? ", with 95 % intervals of three or more" : "";
  const runs = rows.length === 1 ? "1 run" : `${rows.length} runs`;
  const also = others.map((s) => s.title).join("; ");
  byId("said").textContent = `${runs}.${not} ${kind} means over ${over}${pooledBy}${intervals}.` +
    (also ? ` Each point also averages over ${also}, ${metric.average === "plain" ? "arithmetically" : "geometrically"}: ` +
      "choose a colour, panels, or only some." : "");
}

// What a click on a run's dot offers: its picture, or the command that draws it.
function pick(event) {
  const row = event.points.map(({ customdata: c }) => (Array.isArray(c) ? c[3] : c)).find(Number.isInteger);
  if (row === undefined) return;
  const key = data.keys[row];
  const picture = data.pictures[key];
  const made = document.createElement(picture ? "a" : "code");
  if (picture) made.href = picture;
  made.textContent = picture ? "watch" : `estima view ${data.name}/${key}${data.options} -o run.html`;
  byId("picked").replaceChildren(`${named(row).join(", ")}. `, made, " ");
  if (picture) return;
  const copy = document.createElement("button");
  copy.className = "copy";
  copy.textContent = "copy";
  byId("picked").append(copy);
}

// A button copies the command before it; where that is not allowed, it selects it.
async function copied(event) {
  if (!event.target.matches(".copy")) return;
  const command = event.target.previousElementSibling;
  getSelection().selectAllChildren(command);
  try {
    await navigator.clipboard.writeText(command.textContent);
    event.target.textContent = "copied";
  } catch {
    event.target.textContent = "selected";
  }
}

// Of one estimator some best and worst runs; of all, the first of each.
function showExtremes() {
  const of = byId("of").value;
  for (const row of byId("extremes").tBodies[0].rows) {
    row.hidden = of ? row.dataset.estimator !== of : !("first" in row.dataset);
  }
}

setUp();
byId("chart").on("plotly_click", pick);
byId("of").addEventListener("change", showExtremes);
document.addEventListener("click", copied);
