// Draws the errors over the commits for the metric that the reader chooses; a click names a commit.
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
let drawn = Promise.resolve(); // one chart after another
let chart; // the view of the last one

const short = (commit) => commit.hash.slice(0, 10);

// The points of a metric; a line ends where its recordings do.
function pointsOf(metric) {
  const lines = {};
  return data.points.filter((p) => p.metric === metric).map((p) => {
    const commit = data.commits[p.number];
    if (p.mark === "new recordings") lines[p.estimator] = p.number;
    const interval = p.low === null ? "" : ` [${p.low}, ${p.high}]`;
    const tip = { commit: short(commit), day: commit.day, subject: commit.subject, value: `${p.value}${interval}` };
    if (p.mark) tip.mark = p.mark + (p.change === null ? "" : `, ${p.change.toPrecision(4)} times`);
    return { ...p, line: lines[p.estimator], tip };
  });
}

function draw() {
  const metric = byId("metric").value;
  const values = pointsOf(metric);
  const spec = structuredClone(data.spec);
  const box = byId("chart").parentElement.clientWidth - 40; // less the menu
  const columns = Math.max(1, Math.min(3, Math.floor(box / 320)));
  spec.spec.width = Math.max(120, (box - 75 * columns) / columns);
  spec.spec.encoding.x.axis.tickCount = Math.floor(spec.spec.width / 90);
  spec.params = [{ name: "hashes", value: data.commits.map((commit) => short(commit).slice(0, 7)) }];
  spec.spec.layer.forEach((layer) => { layer.encoding.y.title = data.titles[metric]; });
  Object.assign(spec, { columns, data: { values } });
  drawn = drawn.then(async () => {
    const { view } = await vegaEmbed("#chart", spec,
      { ast: true, renderer: "svg", actions: { export: true, source: false, compiled: false, editor: false } });
    view.addEventListener("click", (_, item) => pick(item?.datum ?? {}));
    chart = view;
  });
}

function pick({ number, tip }) {
  if (!tip) return;
  const commit = data.commits[number];
  const link = document.createElement(data.address ? "a" : "code");
  if (data.address) link.href = data.address + commit.hash;
  link.textContent = data.address ? short(commit) : `git show ${short(commit)}`;
  byId("picked").replaceChildren(link, ` ${commit.day}: ${commit.subject}${tip.mark ? ` (${tip.mark})` : ""}`);
}

draw();
byId("metric").addEventListener("change", draw);
addEventListener("resize", draw);
