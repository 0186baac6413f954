// Draws the chart of a sweep from what the reader chooses, and offers the commands of runs.
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
for (const metric of data.metrics) {
  metric.values ??= data.revised.map((is, row) => data.metrics[metric.paths[is]]?.values[row] ?? null);
}
const byId = (id) => document.getElementById(id);
let drawn = Promise.resolve(); // one chart after another
let chart; // the view of the last one
const [MOST_LINES, MOST_COMPARED, FAN] = [600, 4, 0.6];
const TICKS = Array.from({ length: 36 }, (_, i) => [1, 2, 5].map((m) => Number(`${m}e${i - 18}`))).flat();

// Values of a column for rows, as words; a column that is not chosen has one empty word.
const NONE = { words: [""], codes: data.failed.map(() => 0) };
const chosen = (id) => data.settings[byId(id).value] ?? NONE;
const word = (setting, row) => setting.words[setting.codes[row]];

// What tells a run from others.
const named = (row) =>
  data.settings.filter((s) => s.codes[row] >= 0 && s.words.length > 1).map((s) => [s.title, word(s, row)]);

const distinct = (rows, name) => new Set(rows.map((row) => row[name])).size;

// The runs of the chart with what the specification needs of them; what is not drawn, in words.
function chosenRuns(across, colour, panels, metric) {
  const out = [...document.querySelectorAll("#filters input:not(:checked)")];
  const kept = [...data.failed.keys()].filter((row) =>
    out.every((box) => data.settings[box.name].codes[row] !== Number(box.value)));
  const ended = kept.filter((row) => !data.failed[row]);
  const whole = ended.filter((row) =>
    metric.values[row] !== null && [across, colour, panels].every((s) => s.codes[row] >= 0));
  const left = [[kept.length - ended.length, "failed"], [ended.length - whole.length, "without a finite value"]];
  const not = left.filter(([n]) => n).map((parts) => parts.join(" ")).join(", ");
  const middle = (colour.words.length - 1) / 2;
  const runs = whole.map((row) => ({
    row, x: (across.numbers ?? across.words)[across.codes[row]], y: metric.values[row],
    colour: word(colour, row), place: colour.codes[row] - middle,
    panel: panels === NONE ? "" : `${panels.title}: ${word(panels, row)}`,
    kind: data.kinds[row], recording: data.recording[row], repeat: data.repeat[row],
    each: byId("each").checked,
    tip: { [metric.title]: metric.values[row], ...Object.fromEntries(named(row)), run: data.statuses[data.status[row]] },
  }));
  return [runs, kept.length ? (not && ` Not drawn: ${not}.`) : null];
}

const isLog = (metric, low, high) => metric.log && low > 0 && high >= 10 * low;

function draw() {
  const [across, colour, panels] = ["x", "colour", "panels"].map(chosen);
  const metric = data.metrics[byId("y").value];
  const [runs, not] = chosenRuns(across, colour, panels, metric);
  byId("chart").hidden = !runs.length;
  drawParallel(runs, metric);
  if (!runs.length) {
    byId("said").textContent = not === null ? "Nothing is chosen." : `0 runs.${not}`;
    return;
  }
  const points = Object.values(Object.groupBy(runs, (r) => JSON.stringify([r.x, r.colour, r.panel])));
  const repeated = points.every((point) => distinct(point, "recording") === 1)
    && points.some((point) => distinct(point, "repeat") > 1);
  for (const run of runs) run.unit = repeated ? run.repeat : run.recording;
  const bounded = points.map((point) => distinct(point, "unit") > 2);
  const also = data.settings.filter((s) => s.pooled && ![across, colour, panels].includes(s)
    && new Set(runs.map((r) => s.codes[r.row])).size > 1);
  const rule = metric.rules[Number(repeated)][bounded.every(Boolean) ? 2 : Number(bounded.some(Boolean))];
  byId("said").textContent = `${runs.length} run${runs.length === 1 ? "" : "s"}.${not} ${rule}.`
    + (also.length ? ` Each point also averages over ${also.map((s) => s.title).join("; ")}: `
      + "choose a colour, panels, or only some." : "");

  const spec = structuredClone(data.spec);
  const narrow = matchMedia("(max-width: 700px)").matches;
  const columns = narrow ? 1 : Math.min(3, distinct(runs, "panel"));
  const box = byId("chart").parentElement.clientWidth - 40; // less the menu
  const [low, high] = [Math.min(...runs.map((r) => r.y)), Math.max(...runs.map((r) => r.y))];
  const log = isLog(metric, low, high);
  const step = across.numbers ? 3 : Math.min(8, 60 / colour.words.length);
  const aside = across.numbers || points.every((point) => point.length === 1) ? 0
    : -12 - step * (colour.words.length - 1);
  const values = {
    average: metric.average, joined: across.joined, floor: metric.floor, t975: data.t975, step, aside,
  };
  spec.params = spec.params.map(({ name }) => ({ name, value: values[name] }));
  const { x, y, color } = spec.spec.encoding;
  spec.spec.layer[0].params[0].select.encodings = across.numbers ? ["x", "y"] : ["y"];
  const { shape } = spec.spec.layer.at(-1).layer.at(-1).encoding;
  Object.assign(x, across.axis);
  Object.assign(y, { title: metric.title, scale: log ? { type: "log", nice: false, padding: 10 } : { zero: low === high },
    axis: { values: log ? TICKS : null } });
  const longest = 40 + 7 * Math.max(...colour.words.map((text) => text.length));
  const legend = colour === NONE ? null
    : { title: colour.title, columns: Math.max(1, Math.floor((box - 60) / longest)), labelLimit: box - 60 };
  for (const channel of [color, shape]) {
    channel.legend = legend;
    channel.scale.domain = colour.words;
  }
  Object.assign(spec.spec, { width: Math.max(120, (box - 55 - 20 * columns) / columns), height: panels === NONE ? 380 : 280 });
  Object.assign(spec, { columns, data: { values: runs } });
  spec.facet.sort = panels.words.map((text) => `${panels.title}: ${text}`);
  drawn = drawn.then(async () => {
    const { view } = await vegaEmbed("#chart", spec,
      { ast: true, renderer: "svg", actions: { export: true, source: false, compiled: false, editor: false } });
    view.addEventListener("click", (_, item) => pick(item?.datum ?? {}));
    chart = view;
  });
}

// The intervals of a sweep that ran until it was decided, in the colours and type of the other chart.
let drawnNarrowing;
function drawNarrowing() {
  if (!data.narrowing) return;
  const spec = { ...structuredClone(data.narrowing), config: data.spec.config };
  spec.spec.width = Math.max(120, byId("narrowing").parentElement.clientWidth - 110);
  drawnNarrowing = vegaEmbed("#narrowing", spec, { ast: true, renderer: "svg", actions: false });
}

// A line a run across the settings that differ, three or more, to the metric: parallel coordinates.
// Lines through one value are fanned out by their rank, the best below.
let drawnParallel = Promise.resolve();
function drawParallel(runs, metric) {
  const ranked = runs.toSorted((a, b) => a.y - b.y);
  const step = Math.max(1, ranked.length / MOST_LINES);
  const shown = ranked.filter((_, i) => Math.floor(i / step) > Math.floor((i - 1) / step));
  const axes = data.settings.filter((s) => new Set(shown.map((run) => s.codes[run.row])).size > 1);
  byId("together").hidden = axes.length < 3 || matchMedia("(max-width: 700px)").matches;
  if (byId("together").hidden) return;
  const [low, high] = [ranked[0].y, ranked.at(-1).y];
  const scaled = isLog(metric, low, high) ? Math.log : (v) => v;
  const level = (y) => (scaled(y) - scaled(low)) / (scaled(high) - scaled(low) || 1);
  const lines = shown.flatMap((run, rank) => {
    const fan = FAN * (rank / Math.max(1, shown.length - 1) - 0.5);
    const about = { row: run.row, tip: run.tip, level: level(run.y) };
    const places = axes.map((s) => ({ ...about, axis: s.title, code: s.codes[run.row],
      place: (s.codes[run.row] + 0.5 + fan) / s.words.length }));
    return [...places.filter((p) => p.code >= 0), { ...about, axis: metric.title, place: about.level }];
  });
  const ticks = axes.flatMap((s) => {
    const every = Math.ceil(s.words.length / 12);
    return s.words.map((text, i) => ({ axis: s.title, place: (i + 0.5) / s.words.length, text }))
      .filter((_, i) => i % every === 0);
  }).concat([low, high].map((v) => ({ axis: metric.title, place: level(v), text: v.toPrecision(3) })));
  byId("lines").textContent = `A line for each run${step > 1 ? `, of ${ranked.length} every ${step.toFixed(1)}th` : ""}, `
    + `from setting to setting. Dark ones, at the bottom of their bundles, have the smallest ${metric.title.split(",")[0]}. `
    + "Point at a line to follow it, click to pick its run.";
  const spec = { ...structuredClone(data.parallel), config: data.spec.config, datasets: { lines, ticks } };
  spec.width = Math.max(120, byId("together").clientWidth - 130);
  drawnParallel = drawnParallel.then(async () => {
    const { view } = await vegaEmbed("#parallel", spec, { ast: true, renderer: "canvas", actions: false });
    view.addEventListener("click", (_, item) => pick(item?.datum ?? {}));
  });
}

// What a click on a run's dot offers: its picture, or the command that draws it; several runs side by side.
const picked = [];
function pick({ row, runs = 1 }) {
  if (row === undefined || runs > 1) return;
  if (!picked.includes(row)) picked.push(row);
  if (picked.length > MOST_COMPARED) picked.shift();
  showPicked();
}

function element(name, ...content) {
  const made = document.createElement(name);
  made.append(...content);
  return made;
}

function showPicked() {
  const box = byId("picked");
  if (picked.length < 2) {
    box.replaceChildren(...picked.flatMap((row) =>
      [`${named(row).map((pair) => pair.join(": ")).join(", ")}. `, ...watching(row)]));
    return;
  }
  const cells = (of) => picked.map((row) => element("td", of(row)));
  const line = (title, of) => element("tr", element("th", title), ...cells(of));
  const number = (v) => (v == null ? "" : v.toPrecision(4));
  const differ = (values) => new Set(values).size > 1;
  const body = element("tbody",
    element("tr", element("th", "run"), ...picked.map((row) => element("td", ...watching(row)))),
    line("ended", (row) => data.statuses[data.status[row]]),
    ...data.settings.filter((s) => differ(picked.map((row) => s.codes[row])))
      .map((s) => line(s.title, (row) => word(s, row) ?? "")),
    ...data.metrics.filter((m) => differ(picked.map((row) => m.values[row])))
      .map((m) => line(m.title, (row) => number(m.values[row]))));
  const clear = element("button", "compare others");
  clear.addEventListener("click", () => { picked.length = 0; showPicked(); });
  const table = element("table", element("caption", "What differs between the runs picked"), body);
  table.className = "rows compared";
  const scroll = element("div", table);
  scroll.className = "scroll";
  box.replaceChildren(scroll, clear);
}

// A link to a run's picture, or the command that draws it and a button that copies it.
function watching(row) {
  const key = data.keys[row];
  const picture = data.pictures[key];
  const made = element(picture ? "a" : "code",
    picture ? "watch" : `estima view ${data.called}/${key}${data.options} -o run.html`);
  if (picture) {
    made.href = picture;
    return [made];
  }
  const copy = element("button", "copy");
  copy.className = "copy";
  return [made, " ", copy];
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

draw();
drawNarrowing();
byId("chosen").addEventListener("change", draw);
addEventListener("resize", draw);
addEventListener("resize", drawNarrowing);
byId("of").addEventListener("change", showExtremes);
document.addEventListener("click", copied);
