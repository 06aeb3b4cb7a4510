// Plots of numbers over time, by uPlot (uplot/LICENSE). The viewer keeps the samples (series.py), this asks for those shown.
"use strict";

const MAX_PLOTS = 6;
const PLOT_HEIGHT = 110;
const PLOT_COLOURS = ["wall", "object", "truth", "image", "track", "los-edge"];
const FIRST_CHOICE = ["perception/hidden_objects", "latency_ms"];
const FIRST_PLOTS = [FIRST_CHOICE, ["perception/hidden_objects", "objects.count"]];

// fields: [number, group, field] as the viewer lists them; shown: one entry a plot, kept by name over restarts
const plots = { fields: [], shown: [], now: 0, data: new Map() };

function startPlots() {
  try {
    const kept = JSON.parse(recall("plots")) || FIRST_PLOTS;
    for (const [group, field] of kept) if (typeof group === "string" && typeof field === "string") addPlot(group, field);
  } catch {
    // what was kept is not ours
  }
  byId("plot-group").addEventListener("change", () => fillFields(""));
  byId("plot-add").addEventListener("click", () => {
    addPlot(byId("plot-group").value, byId("plot-field").value);
    keepPlots();
  });
  byId("plot-span").addEventListener("change", drawPlots);
  for (const id of ["plot-group", "plot-field"]) byId(id).addEventListener("blur", fillGroups);
  fillGroups();
  new ResizeObserver(() => {
    for (const plot of plots.shown) if (plot.chart) plot.chart.setSize({ width: plotWidth(), height: PLOT_HEIGHT });
  }).observe(byId("plots"));
}

// A viewer that was started anew counts its series anew.
function forgetSeries() {
  Object.assign(plots, { fields: [], data: new Map() });
  askForSeries();
}

function takeFields(message) {
  plots.fields = message.fields;
  fillGroups();
  askForSeries();
}

function takeSeries(message) {
  if (state.paused) return;
  plots.now = message.now_s;
  plots.data = new Map(message.series.map((one) => [one.id, one]));
  drawPlots();
}

// --- what can be plotted ---------------------------------------------------------------------------------------------

// A list that somebody has open must not change under them.
function fillGroups() {
  if ([byId("plot-group"), byId("plot-field")].includes(document.activeElement)) return;
  fillSelect(byId("plot-group"), [...new Set(plots.fields.map(([, group]) => group))].sort(), FIRST_CHOICE[0]);
  fillFields(FIRST_CHOICE[1]);
  byId("plot-add").disabled = !plots.fields.length;
}

function fillFields(wanted) {
  const group = byId("plot-group").value;
  fillSelect(byId("plot-field"), plots.fields.filter(([, of]) => of === group).map(([, , field]) => field).sort(), wanted);
}

function fillSelect(select, texts, wanted) {
  const before = select.value || wanted;
  if (texts.length === select.options.length && texts.every((text, i) => text === select.options[i].value)) return;
  select.replaceChildren(...texts.map((text) => Object.assign(document.createElement("option"), { value: text, textContent: text })));
  if (texts.includes(before)) select.value = before;
}

// --- which are plotted -----------------------------------------------------------------------------------------------

function addPlot(group, field) {
  if (!group || !field || plots.shown.length >= MAX_PLOTS) return;
  if (plots.shown.some((plot) => plot.group === group && plot.field === field)) return;
  const item = document.createElement("li");
  const head = Object.assign(document.createElement("div"), { className: "plot-head" });
  const name = Object.assign(document.createElement("span"), { className: "plot-name", textContent: `${group}  ${field}` });
  const value = Object.assign(document.createElement("span"), { className: "plot-value" });
  const away = Object.assign(document.createElement("button"), { type: "button", textContent: "\u00d7" });
  away.setAttribute("aria-label", `Remove the plot of ${group} ${field}`);
  const area = document.createElement("div");
  area.setAttribute("role", "img");
  head.append(name, value, away);
  item.append(head, area);
  const plot = { group, field, item, value, area, chart: null };
  away.addEventListener("click", () => removePlot(plot));
  plots.shown.push(plot);
  byId("plots").append(item);
  askForSeries();
  drawPlots();
}

function removePlot(plot) {
  if (plot.chart) plot.chart.destroy();
  plot.item.remove();
  plots.shown = plots.shown.filter((other) => other !== plot);
  keepPlots();
  askForSeries();
  byId("plot-add").focus();
  buildPlots();
}

function keepPlots() {
  remember("plots", JSON.stringify(plots.shown.map(({ group, field }) => [group, field])));
}

const numberOf = (plot) => (plots.fields.find(([, group, field]) => group === plot.group && field === plot.field) || [null])[0];

function askForSeries() {
  const ids = plots.shown.map(numberOf).filter((id) => id !== null);
  if (plots.asked === ids.join() && plots.askedOf === socket) return;
  Object.assign(plots, { asked: ids.join(), askedOf: socket });
  send({ type: "plot", ids });
}

// --- drawing ---------------------------------------------------------------------------------------------------------

const plotWidth = () => Math.max(byId("plots").clientWidth, 120);

// The last sample that is a number, and null where the line has ended.
function newestOf(data) {
  return data && data.v.length ? data.v[data.v.length - 1] : null;
}

function numberText(value) {
  if (value === null || value === undefined) return "\u2013";
  const size = Math.abs(value);
  return size !== 0 && (size < 1e-3 || size >= 1e6) ? value.toExponential(2) : String(Number(value.toPrecision(4)));
}

function drawPlots() {
  for (const plot of plots.shown) drawPlot(plot);
}

// Colours are those of the page: another theme takes other charts.
function buildPlots() {
  for (const plot of plots.shown) {
    if (plot.chart) plot.chart.destroy();
    plot.chart = null;
  }
  drawPlots();
}

function drawPlot(plot) {
  const data = plots.data.get(numberOf(plot));
  const times = data ? data.t : [];
  if (!plot.chart) plot.chart = new uPlot(optionsOf(plot), [[], []], plot.area);
  // the same samples need no new scale: a zoom stays
  if (plot.data !== data || !state.recording) {
    plot.data = data;
    plot.chart.setData([times, data ? data.v : []], false);
    plot.chart.setScale("x", shownSpan());
  } else {
    plot.chart.redraw(false);
  }
  showValue(plot);
}

// The same for all plots: live back from now, of a recording from the first sample of any to the last.
function shownSpan() {
  if (!state.recording) return { min: -Number(byId("plot-span").value), max: 0 };
  const spans = [...plots.data.values()].filter(({ t }) => t.length).map(({ t }) => [t[0], t[t.length - 1]]);
  const [min, max] = [Math.min(0, ...spans.map(([first]) => first)), Math.max(0, ...spans.map(([, last]) => last))];
  return { min, max: Math.max(max, min + 1e-3) };
}

function showValue(plot) {
  const { data, chart } = plot;
  const under = chart && chart.cursor.idx !== null && chart.cursor.idx !== undefined && data ? chart.cursor.idx : null;
  const index = under ?? (state.recording ? sampleAt(data) : null);
  const value = index === null ? newestOf(data) : data.v[index];
  const when = under === null ? "" : `  at ${data.t[under].toFixed(1)} s`;
  plot.value.textContent = numberOf(plot) === null ? "not measured" : `${numberText(value)}${when}`;
  const numbers = data ? data.v.filter((one) => one !== null) : [];
  const range = numbers.length ? `, ${numberText(numbers.reduce((a, b) => Math.min(a, b)))} to ${numberText(numbers.reduce((a, b) => Math.max(a, b)))}` : "";
  plot.area.setAttribute("aria-label", `${plot.group} ${plot.field} over time: ${plot.value.textContent}${range}`);
}

// The last sample up to the time of the shown scan, with what came just behind it.
function sampleAt(data) {
  if (!data || !state.timeline) return null;
  let index = -1;
  while (index + 1 < data.t.length && data.t[index + 1] <= state.timeline.time_s + 0.01) index += 1;
  return index < 0 ? null : index;
}

function optionsOf(plot) {
  const style = getComputedStyle(document.documentElement);
  const colour = (name) => style.getPropertyValue(`--${name}`).trim();
  const font = "11px system-ui, sans-serif";
  const axis = { stroke: colour("axis"), font, grid: { stroke: colour("grid"), width: 1 }, ticks: { stroke: colour("grid"), width: 1, size: 4 } };
  return {
    width: plotWidth(), height: PLOT_HEIGHT, legend: { show: false }, padding: [6, 8, 0, 0],
    cursor: { y: false, sync: { key: "plots" }, drag: { x: state.recording, y: false, setScale: state.recording } },
    scales: { x: { time: false, auto: false }, y: { range: (_, low, high) => valueRange(low, high) } },
    series: [{}, { stroke: colour(PLOT_COLOURS[plots.shown.indexOf(plot) % PLOT_COLOURS.length]), width: 1.6, points: { size: 4 } }],
    axes: [
      { ...axis, size: 22, gap: 2, values: (_, values) => values.map((value) => `${Number(value.toPrecision(6))} s`) },
      { ...axis, size: 56, gap: 3, values: (_, values) => values.map(numberText) },
    ],
    hooks: { draw: [drawShownTime], setCursor: [() => showValue(plot)], ready: [seekByClick] },
  };
}

function valueRange(low, high) {
  if (low === null || low === undefined || !Number.isFinite(high - low)) return [0, 1];
  const margin = high > low ? 0.08 * (high - low) : Math.max(0.1 * Math.abs(low), 0.5e-3 * (low === 0 ? 1000 : Math.abs(low)));
  return [low - margin, high + margin];
}

// Where the shown scan of a recording stands.
function drawShownTime(chart) {
  if (!state.recording || !state.timeline) return;
  const x = Math.round(chart.valToPos(state.timeline.time_s, "x", true));
  const { left, top, width, height } = chart.bbox;
  if (x < left || x > left + width) return;
  chart.ctx.save();
  chart.ctx.fillStyle = colours.text;
  chart.ctx.fillRect(x - 1, top, 2, height);
  chart.ctx.restore();
}

// A click goes to the scan of its time; uPlot keeps those to itself that end a drag.
function seekByClick(chart) {
  chart.over.addEventListener("click", (event) => {
    if (!state.recording || !state.overview) return;
    send({ type: "seek", index: scanNearest(chart.posToVal(event.clientX - chart.over.getBoundingClientRect().left, "x")) });
  });
}

function scanNearest(time) {
  const after = scanAfter(time);
  const times = state.overview.times_s;
  return after > 0 && time - times[after - 1] < times[after] - time ? after - 1 : after;
}
