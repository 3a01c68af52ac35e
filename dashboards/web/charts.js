// The report's charts: Plotly figures in the colours of the page, each with a table of its numbers.
"use strict";

// A select with its label. `options` are pairs of value and text.
function makeSelect(label, options, value, onChange) {
  const select = make("select", {"aria-label": label});
  for (const [option, text] of options) select.append(make("option", {value: option}, text));
  select.value = value;
  select.addEventListener("change", () => onChange(select.value));
  return make("label", {}, label, select);
}

function makeTable({header, rows}) {
  const head = make("tr", {}, ...header.map(text => make("th", {scope: "col"}, text)));
  const body = rows.map(row => make("tr", {}, ...row.map((text, i) => i ? make("td", {}, text)
    : make("th", {scope: "row"}, text))));
  return make("table", {}, make("thead", {}, head), make("tbody", {}, ...body));
}

function makeNumbers(table, label = "Numbers") {
  return make("details", {}, make("summary", {}, label), make("div", {class: "table-box", tabindex: "0"}, makeTable(table)));
}

// A copy of a Plotly figure in which colours written --name are replaced by the values of the page's CSS variables.
function coloured(value, style) {
  if (typeof value === "string") return value.startsWith("--") ? style.getPropertyValue(value).trim() : value;
  if (Array.isArray(value)) return value.map(item => coloured(item, style));
  if (value === null || typeof value !== "object") return value;
  return Object.fromEntries(Object.entries(value).map(([name, item]) => [name, coloured(item, style)]));
}

const AXIS = {gridcolor: "--faint", linecolor: "--line", zerolinecolor: "--line", tickfont: {color: "--muted"},
  title: {font: {color: "--muted", size: 12.5}, standoff: 8}, automargin: true};
const TEMPLATE = {layout: {
  paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", xaxis: AXIS, yaxis: AXIS,
  font: {family: 'system-ui, -apple-system, "Segoe UI", Roboto, sans-serif', size: 12.5, color: "--text"},
  hoverlabel: {bgcolor: "--panel", bordercolor: "--line", font: {color: "--text"}},
}};

function drawPlot(plot, figure) {
  const style = getComputedStyle(document.documentElement);
  const {data: traces, layout} = coloured({data: figure.data, layout: {...figure.layout, autosize: true, template: TEMPLATE}}, style);
  plot.style.height = layout.height + "px";  // otherwise a redraw during a change of width may set it to 0
  Plotly.react(plot, traces, layout, {responsive: true, displayModeBar: false});
}

class Chart {
  constructor(spec) {
    this.chosen = {};
    this.choiceBox = make("div", {class: "choices"});
    this.panels = make("div", {class: "panels"});
    this.numbers = make("div");
    this.section = make("section", {id: spec.key}, make("h2", {}, spec.title), make("p", {class: "note"}, spec.note),
      this.choiceBox, this.panels, this.numbers);
  }

  // Takes newer data and keeps the reader's choices if they still exist.
  update(spec) {
    this.spec = spec;
    for (const {name, options, default: first} of spec.choices) {
      if (!options.some(([value]) => value === this.chosen[name])) this.chosen[name] = first;
    }
    const offered = spec.choices.filter(choice => choice.options.length > 1);
    this.choiceBox.replaceChildren(...offered.map(({name, label, options}) =>
      makeSelect(label, options, this.chosen[name], value => this.choose({[name]: value}))));
    this.choiceBox.hidden = offered.length === 0;
    this.draw();
  }

  choose(values) {
    for (const {name, options} of this.spec.choices) {
      if (name in values && options.some(([value]) => value === values[name])) this.chosen[name] = values[name];
    }
    this.update(this.spec);
  }

  key() { return this.spec.choices.map(({name}) => this.chosen[name]).join("|"); }

  draw() {
    const view = this.spec.views[this.key()];
    this.section.dataset.view = this.key();
    if (!view) {
      this.panels.replaceChildren(make("p", {class: "empty"}, "There is no data for this choice yet."));
      this.numbers.replaceChildren();
      return;
    }
    if (this.panels.children.length !== view.panels.length || this.panels.querySelector(".empty")) {
      this.panels.replaceChildren(...view.panels.map(() => this.makePanel()));
    }
    view.panels.forEach((panel, i) => this.drawPanel(this.panels.children[i], panel));
    const open = this.numbers.querySelector("details[open]") !== null;
    this.numbers.replaceChildren(makeNumbers(view.table));
    this.numbers.firstChild.open = open;
  }

  makePanel() {
    const plot = make("div", {class: "plot", role: "img"});
    return make("figure", {class: "panel"}, make("figcaption"), make("div", {class: "scroller"}, plot));
  }

  drawPanel(node, panel) {
    const plot = node.querySelector(".plot");
    node.classList.toggle("wide", panel.wide);
    node.querySelector("figcaption").textContent = panel.title;
    plot.setAttribute("aria-label", this.spec.title + ": " + panel.title + ". The numbers are in the table below.");
    drawPlot(plot, panel.figure);
    if (this.onClick && !plot.clickable) {
      plot.clickable = true;
      plot.on("plotly_click", event => this.onClick(node.querySelector("figcaption").textContent, event.points[0]));
    }
  }
}
