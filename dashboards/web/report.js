// The report: makes its sections from the data; a served page also requests newer data.
"use strict";
const VERDICT_MARKS = {"holds": ["✓", "holds"], "does not hold": ["✗", "fails"], "undecided": ["?", "undecided"],
  "no data": ["–", "none"]};
const REFRESH_S = Number(document.body.dataset.refreshS);  // 0 if the page was opened from disk
const charts = new Map();
let content = null;   // the report's data

async function unpackText(id) { return new TextDecoder().decode(await inflate(element(id).textContent)); }

async function startReport() {
  document.head.append(make("script", {}, await unpackText("plotly")));
  showContent(JSON.parse(await unpackText("data")));
  document.body.dataset.ready = "yes";
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => charts.forEach(chart => chart.draw()));
  if (REFRESH_S > 0) setInterval(refresh, 1000 * REFRESH_S);
}

function showContent(newer) {
  content = newer;
  element("subtitle").textContent = content.subtitle;
  element("made").textContent = content.made;
  element("facts").replaceChildren(...content.facts.map(([name, value]) =>
    make("div", {}, make("dt", {}, name), make("dd", {}, value))));
  for (const spec of content.charts) showChart(spec);
  showClaims();
  for (const table of content.tables) showTable(table);
  episodes.update(content.episodes);
  buildContents();
}

// Inserts a section at its place in the order that the data gives.
function place(section) {
  if (section.parentNode) return;
  const order = content.order, after = order.slice(order.indexOf(section.id) + 1);
  const next = after.map(id => document.querySelector("#sections > #" + id)).find(node => node);
  element("sections").insertBefore(section, next || null);
}

function showChart(spec) {
  const known = charts.get(spec.key);
  if (known) return known.update(spec);
  const chart = new Chart(spec);
  charts.set(spec.key, chart);
  place(chart.section);  // before drawing, so that plots have a width
  if (spec.key === "success") followClicks(chart);
  chart.update(spec);
}

// A click on a cell of a heat map selects its setup in the other charts and in the player.
function followClicks(chart) {
  chart.onClick = (methodName, point) => {
    const method = Object.keys(content.methods).find(name => content.methods[name] === methodName);
    const setup = point.y + "×" + point.x, preset = chart.chosen.preset;
    charts.get("transfer")?.choose({preset, method, trained: setup});
    charts.get("curves")?.choose({setup});
    episodes.choose({preset, policy: "learned", method, trained: setup, played: setup});
    chart.message.textContent = methodName + " " + setup + " is shown in the charts and in the player below.";
  };
  chart.message = make("p", {class: "note", role: "status"});
  chart.numbers.before(chart.message);
}

function showClaims() {
  if (!content.claims.length) return;
  const section = element("claims") || make("section", {id: "claims"});
  const open = new Set([...section.querySelectorAll("details[open]")].map(node => node.dataset.claim));
  const how = make("details", {"data-claim": "how"}, make("summary", {}, "How claims are judged"),
    make("p", {class: "note"}, content.claims_note));
  how.open = open.has("how");
  section.replaceChildren(make("h2", {}, "The dissertation’s claims"), how);
  for (const {preset, tally, claims} of content.claims) {
    section.append(make("p", {}, make("b", {}, "Preset " + preset + ": "), tally), claimsTable(preset, claims, open));
  }
  place(section);
}

function claimsTable(preset, claims, open) {
  const rows = claims.map(claim => {
    const [mark, kind] = VERDICT_MARKS[claim.verdict], key = preset + " " + claim.number;
    const details = makeNumbers({header: claim.header, rows: claim.checks},
      claim.checks.length === 1 ? "1 check" : claim.checks.length + " checks");
    details.dataset.claim = key;
    details.open = open.has(key);
    return make("tr", {"data-claim": claim.number, "data-verdict": claim.verdict},
      make("td", {}, String(claim.number)), make("td", {class: "text"}, claim.text),
      make("td", {}, make("span", {class: "verdict-mark " + kind}, mark + " " + claim.verdict)),
      make("td", {}, claim.evidence, details));
  });
  const head = make("tr", {}, ...["#", "claim", "verdict", "evidence"].map(text => make("th", {scope: "col"}, text)));
  return make("table", {class: "claims"}, make("thead", {}, head), make("tbody", {}, ...rows));
}

function showTable({key, title, note, table}) {
  const section = element(key) || make("section", {id: key});
  section.replaceChildren(make("h2", {}, title), make("p", {class: "note"}, note),
    make("div", {class: "table-box", tabindex: "0"}, makeTable(table)));
  section.hidden = table.rows.length === 0;
  place(section);
}

function buildContents() {
  const sections = [...document.querySelectorAll("#sections > section, #episodes")].filter(node => !node.hidden);
  element("contents").replaceChildren(...sections.map(node =>
    make("a", {href: "#" + node.id}, node.querySelector("h2").textContent)));
}

// Requests newer data, unless the page is hidden.
async function refresh() {
  if (document.hidden) return;
  const status = element("status");
  status.hidden = false;
  try {
    const answer = await fetch("data.json", {cache: "no-cache"});
    if (!answer.ok) throw new Error(answer.statusText);
    const newer = await answer.json();
    status.className = "muted live";
    status.textContent = "Live, updated at " + new Date().toLocaleTimeString();
    if (newer.stamp !== content.stamp) showContent(newer);
  } catch (error) {
    status.className = "muted stopped";
    status.textContent = "The server does not answer; this is its last answer.";
  }
}
