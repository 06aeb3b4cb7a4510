// The page of the viewer: takes updates from the websocket, holds the newest, draws it. Nothing from outside.
"use strict";

const byId = (id) => document.getElementById(id);
const TILE_HEADER_BYTES = 16;
const TILE_MAP = 1;
const TILE_MASK = 2;
const TILE_POINTS = 3;
const NEAR_S = 1;
const DYNAMIC_RANGE_DB = 55;
const NOISE_TOP_DB = 10;
const LEAST_TOP_DB = 40;
const ANNOUNCE_MS = 4000;
const WARNINGS_STALE_MS = 3000;
const LABELLED_TRACKS = 20;
const LISTED_TRACKS = 12;
const SLOW_MPS = 0.5;
const RECONNECT_MS = [500, 1000, 2000, 4000, 8000];
const PROOF_MS = 5000;

const LAYERS = [
  { key: "mask", name: "observable directly", on: true, swatch: (c) => drawMaskSwatch(c, 1), more: ["in a mirror", (c) => drawMaskSwatch(c, 2)] },
  { key: "walls", name: "walls", on: true, swatch: drawWallSwatch },
  { key: "los", name: "direct returns", on: true, swatch: (c) => drawDot(c, 11, 8, 3.5) },
  { key: "images", name: "mirror images", on: true, swatch: (c) => drawDiamond(c, 11, 8, 5) },
  { key: "objects", name: "recovered", on: true, swatch: drawObjectSwatch },
  { key: "truth", name: "truth", on: true, swatch: drawTruthSwatch },
  { key: "map", name: "map beneath", on: false, swatch: drawMapSwatch },
  { key: "grid", name: "grid", on: true, swatch: drawGridSwatch },
  { key: "tracks", name: "followed", on: true, swatch: drawTrackSwatch, hint: "followed over scans: where it was, where it goes, where it comes into sight" },
  { key: "lidar", name: "LiDAR slice", on: true, swatch: drawLidarSwatch },
];

const COLOUR_NAMES = [
  "text", "unknown", "direct", "mirrored", "hatch", "grid", "axis", "wall", "los", "los-edge", "image", "place", "object", "object-fill",
  "sigma", "truth", "truth-seen", "surface", "ego", "label", "track", "lidar", "urgent", "caution", "notice",
];

const state = {
  connection: "waiting", title: "", recording: false, colours: [],
  paused: false, missed: 0, number: null, announced: "",
  // what is shown, and what came while paused
  sensor: null, view: null, mask: null, viewAt: 0, map: null, tile: null, nodes: [], graph: null, timeline: null,
  lidar: null, image: null, bitmap: null,
  held: { view: null, map: null, lidar: null, image: null }, labels: [],
  warnings: [], warningsAt: null, overview: null, sound: false, loop: false,
  layers: Object.fromEntries(LAYERS.map((layer) => [layer.key, layer.on])),
  form: "cartesian", reach: 50, theme: null,
};
const camera = { x: 15, y: 0, scale: 10, fitted: null, free: false };
const arrivals = [];
let colours = {};
let ramp = null;
let dirty = { bev: true, map: true, camera: true };
// CSS pixels of the map's canvas, from range and azimuth, in the form that is drawn
let mapToCanvas = null;

// The viewer's clock: by the least delay an update had so far, which may grow by 0.2 ms a second as clocks drift apart.
// So an update that took long to come, or waited in this page, is as old as it is, and the browser's own time is not asked.
const clock = { behind: Infinity, at: 0 };
const viewerNow = () => performance.now() - clock.behind;

function hearClock(now) {
  const at = performance.now();
  clock.behind = Math.min(at - now, clock.behind + 2e-4 * (at - clock.at));
  clock.at = at;
}

// --- the websocket ---------------------------------------------------------------------------------------------------

let socket = null;
let attempts = 0;
let update = null;

function connect() {
  const address = new URL("ws", location.href);
  address.protocol = "ws:";
  socket = new WebSocket(address);
  socket.binaryType = "arraybuffer";
  socket.onmessage = (event) => receive(event.data);
  socket.onclose = (event) => {
    setConnection({ 1013: "full", 1012: state.recording ? "lost" : "ended" }[event.code] || "lost");
    tryLater();
  };
}

function tryLater() {
  setTimeout(reconnect, RECONNECT_MS[Math.min(attempts++, RECONNECT_MS.length - 1)]);
}

// The viewer may come back, or another program may have its port by now: whoever answers proves that it knows the
// token before it is told the token.
async function reconnect() {
  let proven = null;
  try {
    proven = await knowsToken();
  } catch {
    // nobody answers
  }
  if (proven) return connect();
  if (proven !== null) setConnection("other");
  else if (state.connection !== "ended") setConnection("lost");
  return tryLater();
}

async function knowsToken() {
  const hexOf = (bytes) => [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("");
  const nonce = hexOf(crypto.getRandomValues(new Uint8Array(16)));
  const answer = await fetch(`/proof/${nonce}`, { redirect: "error", signal: AbortSignal.timeout(PROOF_MS) });
  const said = await answer.text();
  const text = new TextEncoder();
  const use = { name: "HMAC", hash: "SHA-256" };
  const key = await crypto.subtle.importKey("raw", text.encode(location.pathname.split("/")[1]), use, false, ["sign"]);
  return said === hexOf(new Uint8Array(await crypto.subtle.sign("HMAC", key, text.encode(nonce))));
}

function send(message) {
  if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

// An update is announced with the number of its messages; when all have come it is shown and acknowledged.
function receive(data) {
  if (update === null) {
    const message = JSON.parse(data);
    if (message.type === "hello") return greet(message);
    update = { ...message, got: [] };
    hearClock(message.now_ms);
  } else {
    update.got.push(data);
  }
  if (update.got.length < update.messages) return;
  const complete = update;
  update = null;
  try {
    take(complete);
  } finally {
    send({ type: "ack", number: complete.number });
  }
}

function greet(message) {
  attempts = 0;
  update = null;
  clock.behind = Infinity;
  hearClock(message.now_ms);
  Object.assign(state, { title: message.title, recording: message.recording, colours: message.colours });
  ramp = colourRamp(message.colours);
  byId("title").textContent = message.title;
  document.title = `mirrorwave ${message.title}`;
  Object.assign(state, { sensor: null, overview: null, warnings: [], warningsAt: message.now_ms });
  byId("timeline").hidden = !message.recording;
  byId("sensor").hidden = true;
  document.body.toggleAttribute("data-recording", message.recording);
  byId("pause").hidden = message.recording;
  setConnection("live");
  forgetSeries();
  for (const layer of LAYERS) drawSwatch(layer);
}

function take({ kinds, got, now_ms: now }) {
  for (let at = 0; at < got.length; at += 1) {
    const message = JSON.parse(got[at]);
    const bytes = got[at + 1] instanceof ArrayBuffer ? got[(at += 1)] : null;
    const tile = bytes && message.type !== "image" ? readTile(bytes) : null;
    const posted = now - kinds[message.type].held_ms;
    if (message.type === "view") takeView({ message, mask: tile, at: posted });
    else if (message.type === "map") takeMap({ message, tile, at: posted });
    else if (message.type === "lidar") takeSide("lidar", { message, tile, at: posted });
    else if (message.type === "image") takeSide("image", { message, bytes, at: posted });
    else if (message.type === "nodes") { state.nodes = message.nodes; state.graph = message.graph; showNodes(); }
    else if (message.type === "timeline") { state.timeline = message; showTimeline(); }
    else if (message.type === "sensor") showSensor(message);
    else if (message.type === "fields") takeFields(message);
    else if (message.type === "series") takeSeries(message);
    else if (message.type === "overview") { state.overview = message; drawStrip(); }
    else if (message.type === "warnings") { state.warnings = message.warnings; state.warningsAt = posted; showWarnings(); }
  }
}

function takeView(news) {
  // the same view may come again with its truth; after a restart numbers begin anew
  const passed = news.message.number - (state.number ?? news.message.number - 1);
  state.number = news.message.number;
  if (passed !== 0) arrivals.push(news.at);
  if (!state.recording) state.missed += Math.max(state.paused ? passed : passed - 1, 0);
  if (!state.paused) return showView(news);
  state.held.view = news;
  return showFigures();
}

function takeMap(news) {
  if (state.paused) state.held.map = news;
  else showMap(news);
}

function takeSide(kind, news) {
  if (state.paused) state.held[kind] = news;
  else SHOW_SIDE[kind](news);
}

function readTile(buffer) {
  const head = new DataView(buffer, 0, TILE_HEADER_BYTES);
  const tile = {
    kind: head.getUint8(3), scan: head.getUint32(4, true), rows: head.getUint16(8, true), columns: head.getUint16(10, true),
    floor: head.getInt16(12, true) / 100, step: head.getUint16(14, true) / 1000,
  };
  if (tile.kind === TILE_POINTS) return { ...tile, cells: new Int16Array(buffer, TILE_HEADER_BYTES) };
  const bytes = new Uint8Array(buffer, TILE_HEADER_BYTES);
  tile.cells = tile.kind === TILE_MASK ? unpackQuads(bytes, tile.rows * tile.columns) : bytes;
  return tile;
}

function unpackQuads(bytes, count) {
  const cells = new Uint8Array(count);
  for (let i = 0; i < count; i += 1) cells[i] = (bytes[i >> 2] >> (2 * (i & 3))) & 3;
  return cells;
}

// --- what the page says ----------------------------------------------------------------------------------------------

function setConnection(connection) {
  state.connection = connection;
  if (connection !== "live") update = null;
  showFigures();
  showWarnings();
}

// Whose eyes these are, for eyes and for screen readers: the same scene looks different to each sensor.
function showSensor(message) {
  state.sensor = message;
  byId("sensor").textContent = message.text;
  byId("sensor").hidden = false;
  byId("latency-figure").title = `Start of the scan to its view here; the scan itself takes ${Number(message.scan_s.toFixed(2))} s of it`;
  if (state.view) byId("bev").setAttribute("aria-label", bevLabel(state.view));
}

const sensorWords = () => (state.sensor ? `${state.sensor.text}, ` : "");
const bevLabel = (view) => `Bird’s-eye view, ${sensorWords()}scan ${view.scan_id}: ${view.summary}`;

function showView({ message, mask, at }) {
  Object.assign(state, { view: message, mask, viewAt: at, maskImage: null });
  byId("summary").textContent = message.summary;
  byId("flags").textContent = message.flags.map((flag) => flag.replaceAll("_", " ")).join(", ");
  byId("bev").setAttribute("aria-label", bevLabel(message));
  showObjects();
  showTracks();
  announce(message);
  if (!camera.free) fit(false);
  dirty.bev = true;
  showFigures();
}

function showMap({ message, tile, at }) {
  Object.assign(state, { map: message, tile, mapAt: at, planeImage: null, polarImage: null });
  const conditions = [
    ["coherent", "photons"].includes(message.mode) ? "" : `${message.mode} mode`,
    message.incoherent_share > 0 ? `${(100 * message.incoherent_share).toFixed(0)} % of ranges incoherent` : "",
    message.missing_beams.length ? `beams ${message.missing_beams.join(", ")} missing` : "",
    message.saturated_share > 0 ? `${(100 * message.saturated_share).toFixed(1)} % saturated` : "",
    message.ego_compensated ? "ego motion taken out" : "",
  ].filter(Boolean);
  const peak = `peak ${message.peak_db.toFixed(0)} ${message.reference === "noise" ? message.unit : "dB"}`;
  byId("map-note").textContent = [`scan ${message.scan_id}`, peak, ...conditions].join(" · ");
  byId("map").setAttribute("aria-label", `Range-azimuth map, ${sensorWords()}scan ${message.scan_id}, ${peak}`);
  dirty.map = true;
  if (state.layers.map) dirty.bev = true;
}

// The sensors beside the radar, as they saw the time of the view.
const SHOW_SIDE = { lidar: showLidar, image: showImage };

function showLidar({ message, tile, at }) {
  state.lidar = { message, tile, at };
  byId("layer-lidar").parentElement.hidden = false;
  byId("layer-lidar").parentElement.title = message.text;
  dirty.bev = true;
}

async function showImage({ message, bytes, at }) {
  const { stamp_s: stamp } = message;
  state.image = { message, at };
  byId("camera-section").hidden = false;
  byId("camera-note").textContent = message.text;
  byId("camera").setAttribute("aria-label", `Camera, ${message.text}`);
  let bitmap = null;
  try {
    bitmap = await createImageBitmap(new Blob([bytes], { type: "image/jpeg" }));
  } catch {
    byId("camera-note").textContent = `${message.text}: this image cannot be shown`;
  }
  // a later one may have been ready before
  if (state.image.message.stamp_s !== stamp) return;
  if (state.bitmap) state.bitmap.close();
  state.bitmap = bitmap;
  dirty.camera = true;
}

function drawCamera() {
  const canvas = byId("camera");
  const c = prepare(canvas);
  const { bitmap } = state;
  if (!bitmap) return;
  const scale = Math.min(canvas.clientWidth / bitmap.width, canvas.clientHeight / bitmap.height);
  const [width, height] = [bitmap.width * scale, bitmap.height * scale];
  c.drawImage(bitmap, (canvas.clientWidth - width) / 2, (canvas.clientHeight - height) / 2, width, height);
}

// Of a cloud or image: how far from the view in time, where that is too far to belong to it.
function offText(side) {
  const off = side && state.view ? side.message.stamp_s - state.view.stamp_s : 0;
  return Math.abs(off) > NEAR_S ? `${ageText(Math.abs(off))} ${off < 0 ? "before" : "after"} this view` : "";
}

// Screen readers hear of a new count at once, of a move beyond 1 m, and never more often than they can speak.
let announcedAt = -Infinity;
let announcedPlaces = "";
function announce(view) {
  const places = view.objects.map((one) => one.at.map(Math.round).join()).join(" ");
  if (places === announcedPlaces || performance.now() - announcedAt < ANNOUNCE_MS) return;
  Object.assign(state, { announced: view.summary });
  announcedPlaces = places;
  announcedAt = performance.now();
  byId("announce").textContent = view.summary;
}

// Of a picture by its age: live, late or old. The viewer says the limits (`age_limits_ms`); of no known age is old.
function freshness(age, { late_ms: late, old_ms: old }) {
  if (age === null || age > old) return "old";
  return age > late ? "late" : "live";
}

// Since the measurement of what is shown, whatever comes meanwhile; null where its stamp is of another clock.
const ageOf = (message, at) => (message && message.age_ms !== null ? message.age_ms + viewerNow() - at : null);

function showFigures() {
  // the last one stays: how long it is ago is told
  while (arrivals.length > 1 && arrivals[0] < viewerNow() - 5000) arrivals.shift();
  const { view } = state;
  const age = state.recording ? null : ageOf(view, state.viewAt);
  const [name, text] = linkState(age);
  byId("link").dataset.state = name;
  if (byId("link").textContent !== text) byId("link").textContent = text;
  byId("scan").textContent = view ? view.scan_id : "–";
  const span = arrivals.length > 1 ? (arrivals[arrivals.length - 1] - arrivals[0]) / 1000 : 0;
  byId("rate").textContent = span > 0 ? `${((arrivals.length - 1) / span).toFixed(1)} Hz` : "–";
  showOldPicture(age, name === "old");
  byId("age").textContent = age === null ? "–" : ageText(age / 1000);
  byId("latency").textContent = view && view.latency_ms !== null ? latencyText(view.latency_ms) : "–";
  byId("missed").textContent = state.missed;
  const mapAge = state.recording ? null : ageOf(state.map, state.mapAt);
  const isMapOld = mapAge !== null && view && freshness(mapAge, view) === "old";
  const [cameraOff, lidarOff] = [offText(state.image), offText(state.lidar)];
  byId("camera-age").textContent = cameraOff ? ` · ${cameraOff}` : "";
  byId("layer-lidar-more").textContent = lidarOff ? `(${lidarOff})` : "";
  byId("map-age").textContent = isMapOld ? ` · ${ageText(mapAge / 1000)} old` : "";
}

const latencyText = (latency) => (latency < 10000 ? `${latency.toFixed(0)} ms` : ageText(latency / 1000));

// Why nothing that is shown can be of now.
const CUTS = {
  full: "too many pages look at once", other: "another graph runs here: open the address it printed",
  ended: "the graph has ended", lost: "no connection: has the graph ended?",
};

// Colour and words: the colour follows the age of what is shown alone.
function linkState(age) {
  if (state.connection in CUTS) return ["old", CUTS[state.connection]];
  if (state.connection === "waiting") return ["late", "connecting"];
  if (state.recording) return ["recording", "recording"];
  if (!state.view) return ["late", "waiting for the first view"];
  const level = freshness(age, state.view);
  if (state.paused) return [level === "old" ? "old" : "late", "paused"];
  return [level, level === "old" ? "not live" : level];
}

function whyOld(age) {
  if (state.connection in CUTS) return CUTS[state.connection];
  const gone = state.nodes.find((node) => node.state === "stopping");
  if (isQuiet()) return gone ? `${gone.node} has ended` : "no new view comes";
  if (age === null) return "stamped by another clock";
  return state.view.latency_ms === null ? "played back, measured before this graph began" : "views come late";
}

const isQuiet = () => viewerNow() - arrivals[arrivals.length - 1] > state.view.old_ms;

// What is drawn stays when nothing new comes; it must not pass for the present.
function showOldPicture(age, isOld) {
  const isCut = state.connection in CUTS;
  const isShown = Boolean(state.view) && isOld && (isCut || !state.paused);
  byId("old-picture").hidden = !isShown;
  document.body.toggleAttribute("data-old", isShown && (isCut || isQuiet()));
  if (!isShown) return;
  const what = state.recording ? "Not connected" : age === null ? "Old picture" : `Old picture, ${ageText(age / 1000)} ago`;
  byId("old-picture").textContent = `${what}: ${whyOld(age)}`;
}

function cell(text, className) {
  const td = document.createElement("td");
  // a number keeps its unit on its line
  td.textContent = String(text).replace(/(\d) (?=%|(?:m|s|min|days|km|Hz)\b)/g, "$1\u00a0");
  if (className) td.className = className;
  return td;
}

function row(...cells) {
  const tr = document.createElement("tr");
  tr.append(...cells);
  return tr;
}

function noRow(columns, text) {
  const td = cell(text, "none");
  td.colSpan = columns;
  return row(td);
}

function objectName(one) {
  return one.class ? `#${one.id} ${one.class}` : `#${one.id}`;
}

function showObjects() {
  const { view } = state;
  const rows = view.objects.map((one) => {
    // the viewer says which hidden true object is nearest, and both errors (models/scores/object_error.py)
    const truth = one.nearest;
    return row(
      cell(objectName(one)), cell(`${one.at[0].toFixed(1)}, ${one.at[1].toFixed(1)} m`), cell(`±${one.ellipse[0].toFixed(1)} m`),
      cell(one.score.toFixed(2)), cell(truth ? truth.class : "–"),
      cell(truth ? `${truth.centre_error.toFixed(1)}, ${truth.face_error.toFixed(1)} m` : "–"),
    );
  });
  byId("objects").tBodies[0].replaceChildren(...(rows.length ? rows : [noRow(6, "none seen")]));
}

// --- warnings --------------------------------------------------------------------------------------------------------
// What is warned of, in which order and since when is the viewer's business (driver_warnings.py); here it is only shown.

const SIGNS = { urgent: "\u25B2", caution: "\u25C6", notice: "\u25CF" };
const LEVEL_WORDS = { urgent: "Urgent", caution: "Caution", notice: "Notice" };
const warningItems = new Map();
let alarmed = new Set();

// Warnings that nobody renews are worth nothing, and neither is their absence.
function currentWarnings() {
  const stale = !state.recording && state.warningsAt !== null && viewerNow() - state.warningsAt > WARNINGS_STALE_MS;
  if (state.connection === "live" && !stale) return state.warnings;
  if (state.warningsAt === null) return [];
  return [{ key: "page", level: "caution", title: "Warnings are out of date", detail: "the page hears nothing from the graph", left_s: null, age_s: null, tracks: [], ended: false }];
}

function showWarnings() {
  const warnings = currentWarnings();
  const keys = new Set(warnings.map((one) => one.key));
  for (const key of warningItems.keys()) if (!keys.has(key)) warningItems.delete(key);
  const items = warnings.map(showWarning);
  const list = byId("warning-list");
  if (!items.length) {
    items.push(Object.assign(document.createElement("li"), { className: "calm", textContent: "No warning" }));
  }
  // what stands in its place is left alone, so that it neither flickers nor moves
  const same = list.children.length === items.length && items.every((item, i) => item === list.children[i]);
  if (!same) list.replaceChildren(...items);
  byId("warnings").dataset.level = warnings.length ? warnings[0].level : "none";
  sayAlarm(warnings);
  dirty.bev = true;
}

function showWarning(one) {
  let item = warningItems.get(one.key);
  if (!item) {
    item = document.createElement("li");
    for (const name of ["sign", "words", "left"]) item.append(Object.assign(document.createElement("span"), { className: name }));
    item.children[0].setAttribute("role", "img");
    for (const name of ["title", "detail"]) item.children[1].append(Object.assign(document.createElement("span"), { className: name }));
    item.classList.add("new");
    warningItems.set(one.key, item);
  }
  item.dataset.level = one.level;
  item.dataset.key = one.key;
  item.classList.toggle("ended", one.ended);
  const [sign, words, left] = item.children;
  sign.textContent = SIGNS[one.level];
  sign.setAttribute("aria-label", LEVEL_WORDS[one.level]);
  words.children[0].textContent = one.title;
  words.children[1].textContent = `${one.detail}${sinceText(one)}`;
  item.title = `${one.title}: ${words.children[1].textContent}`;
  left.textContent = one.left_s === null ? "" : one.left_s > 0 ? `${one.left_s.toFixed(1)} s` : "now";
  return item;
}

function sinceText({ age_s: age, ended }) {
  if (ended) return " · over";
  if (age === null || age < 0.5) return "";
  return state.recording && state.timeline ? ` · first at ${Math.max(state.timeline.time_s - age, 0).toFixed(1)} s` : ` · for ${age.toFixed(0)} s`;
}

// Screen readers hear of each urgent warning once, when it begins; so does whoever wants a tone.
function sayAlarm(warnings) {
  const urgent = warnings.filter((one) => one.level === "urgent" && !one.ended);
  const fresh = urgent.filter((one) => !alarmed.has(one.key));
  alarmed = new Set(warnings.filter((one) => one.level === "urgent").map((one) => one.key));
  if (!fresh.length) return;
  byId("alarm").textContent = fresh.map((one) => `${one.title}${alarmTime(one.left_s)}`).join("; ");
  if (state.sound) tone();
}

function alarmTime(left) {
  if (left === null) return "";
  return left < 0.5 ? " now" : ` in ${left.toFixed(0)} seconds`;
}

let audio = null;
function tone() {
  audio = audio || new AudioContext();
  for (const at of [0, 0.18]) {
    const oscillator = new OscillatorNode(audio, { frequency: 880 });
    const gain = new GainNode(audio, { gain: 0.15 });
    oscillator.connect(gain).connect(audio.destination);
    oscillator.start(audio.currentTime + at);
    oscillator.stop(audio.currentTime + at + 0.12);
  }
}

function toggleSound() {
  state.sound = !state.sound;
  byId("sound").setAttribute("aria-pressed", state.sound);
  byId("sound-state").textContent = state.sound ? "on" : "off";
  // heard at once: the wish itself lets the browser speak
  if (state.sound) tone();
}

// --- tracks ----------------------------------------------------------------------------------------------------------

const speedOf = (track) => Math.hypot(...track.velocity);

function showTracks() {
  const { tracks, tracks_total: total } = state.view;
  const rows = tracks.slice(0, LISTED_TRACKS).map((one) => {
    const soon = one.appears_s !== null;
    const item = row(
      cell(`${trackName(one)}${one.misses ? ` (unseen ${one.misses}x)` : ""}`), cell(`${one.at[0].toFixed(1)}, ${one.at[1].toFixed(1)} m`),
      cell(speedText(one)), cell(headingText(one)), cell(soon ? sightText(one) : "–", soon ? "soon" : ""), cell(ageText(one.age_s)),
    );
    item.classList.toggle("missed", one.misses > 0);
    return item;
  });
  if (total > rows.length) rows.push(noRow(6, `and ${total - rows.length} more, less pressing`));
  byId("tracks").tBodies[0].replaceChildren(...(rows.length ? rows : [noRow(6, "none followed")]));
}

// Its number, class and existence, as far as the view gives them.
const trackName = ({ id, class: kind, existence }) =>
  [`T${id}`, kind, existence === null ? "" : `${(100 * existence).toFixed(0)} %`].filter(Boolean).join(" ");
const sightText = ({ appears_s: appears }) => (appears > 0 ? `in ${appears.toFixed(1)} s` : "now");
function ageText(age) {
  if (age < 120) return `${age.toFixed(1)} s`;
  return age < 30 * 86400 ? `${Math.round(age / 60)} min` : `${Math.round(age / 86400)} days`;
}

function speedText(one) {
  const speed = speedOf(one);
  const spread = one.velocity_ellipse ? ` ± ${one.velocity_ellipse[0].toFixed(1)}` : "";
  return `${speed.toFixed(1)}${spread} m/s, ${(3.6 * speed).toFixed(0)} km/h`;
}

function headingText(one) {
  if (speedOf(one) < SLOW_MPS) return "–";
  const heading = Math.round((Math.atan2(one.velocity[1], one.velocity[0]) * 180) / Math.PI);
  return heading === 0 ? "0°" : `${Math.abs(heading)}° ${heading > 0 ? "left" : "right"}`;
}

function showNodes() {
  const rows = [];
  for (const node of state.nodes) {
    const badge = document.createElement("span");
    Object.assign(badge, { className: "state", textContent: node.state });
    badge.dataset.state = node.state;
    const stateCell = document.createElement("td");
    stateCell.append(badge);
    const lost = node.lost + node.rejected;
    rows.push(row(
      breakable(node.node), stateCell, parts(node.rates.map((rate) => `${rate.topic.split("/").pop()} ${rate.hz.toFixed(1)} Hz`)),
      parts(node.stages.map((stage) => `${stage.name}: ${ms(stage.mean_ms)}, ${ms(stage.max_ms)}`)),
      cell(lost, lost ? "lossy" : ""), cell(`${(100 * node.cpu).toFixed(0)}%`), cell(node.memory_mib),
    ));
    const notes = [node.reason, node.shed.length ? `left out so far: ${node.shed.join(", ")}` : ""].filter(Boolean);
    if (notes.length) {
      const why = cell(notes.join("; "));
      why.colSpan = 7;
      const tr = row(why);
      tr.className = "reason";
      rows.push(tr);
    }
  }
  byId("graph").textContent = state.graph ? state.graph.text : "\u00a0";
  byId("graph").classList.toggle("lossy", Boolean(state.graph && !state.graph.well));
  byId("nodes").tBodies[0].replaceChildren(...(rows.length ? rows : [noRow(7, "no heartbeat yet")]));
}

const ms = (value) => (value < 10 ? value.toFixed(1) : value.toFixed(0));

// Parts that stay whole where the cell wraps.
function parts(texts) {
  const td = cell("");
  texts.forEach((textContent, i) => td.append(i ? " · " : "", Object.assign(document.createElement("span"), { textContent })));
  return td;
}

// A name may break behind its underscores and dots, not within its words.
function breakable(name) {
  const td = cell("");
  for (const part of name.split(/(?<=[_.])/)) td.append(part, document.createElement("wbr"));
  return td;
}

function showTimeline() {
  const { index, count, time_s: time, duration_s: duration, playing, loop, loss } = state.timeline;
  const seek = byId("seek");
  seek.max = count - 1;
  if (performance.now() - soughtAt > 400) seek.value = index;
  seek.setAttribute("aria-valuetext", `${time.toFixed(1)} s, scan ${index + 1} of ${count}`);
  byId("clock").textContent = `${time.toFixed(1)} / ${duration.toFixed(1)} s · ${index + 1} of ${count}${loss ? " · incomplete" : ""}`;
  byId("clock").title = loss || "";
  byId("loop").setAttribute("aria-pressed", playing ? loop : state.loop);
  drawPlots();
  setLabel("play", "space", playing ? "Pause" : "Play");
  drawStrip();
}

// The strip above the slider: three lanes, each scan above its place on the slider.
const LANES = [["objects", 2, 9], ["road users", 14, 12], ["sight", 29, 11]];
const STRIP_LEFT = 66;
const STRIP_RIGHT = 8;
const MARK_HEIGHT = { urgent: 1, caution: 0.6, notice: 0.25 };
let soughtAt = -Infinity;

function stripX(index) {
  const width = byId("strip").clientWidth - STRIP_LEFT - STRIP_RIGHT;
  return STRIP_LEFT + (width * index) / Math.max(state.overview.times_s.length - 1, 1);
}

function indexAt(x) {
  const count = state.overview.times_s.length;
  const width = byId("strip").clientWidth - STRIP_LEFT - STRIP_RIGHT;
  return Math.min(Math.max(Math.round(((x - STRIP_LEFT) / Math.max(width, 1)) * (count - 1)), 0), count - 1);
}

// The first scan at or after a time; the last one where there is none.
function scanAfter(time) {
  const times = state.overview.times_s;
  let [low, high] = [0, times.length - 1];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] >= time - 0.005) high = middle;
    else low = middle + 1;
  }
  return low;
}

const laneOf = (mark) => (mark.key.startsWith("hidden/") ? 1 : 2);

function drawStrip() {
  if (!state.overview) return;
  const c = prepare(byId("strip"));
  const { seen, marks } = state.overview;
  const step = Math.max(stripX(1) - stripX(0), 1);
  c.font = "11px system-ui, sans-serif";
  c.fillStyle = colours.axis;
  for (const [name, y, height] of LANES) {
    c.fillText(name, 0, y + height - 3);
    c.globalAlpha = 0.25;
    c.fillRect(STRIP_LEFT, y + height, byId("strip").clientWidth - STRIP_LEFT - STRIP_RIGHT, 1);
    c.globalAlpha = 1;
  }
  c.fillStyle = colours.object;
  seen.forEach((count, i) => {
    const height = Math.min(count, 3) * 3;
    // the first and the last are half as wide: the names of the lanes stand left of them
    const [from, to] = [Math.max(stripX(i) - step / 2, stripX(0)), Math.min(stripX(i) + step / 2, stripX(seen.length - 1))];
    c.fillRect(from, LANES[0][1] + LANES[0][2] - height, Math.max(to - from, 1) + 0.5, height);
  });
  for (const mark of [...marks].reverse()) {
    const [, y, full] = LANES[laneOf(mark)];
    const [from, to] = [stripX(scanAfter(mark.from_s)), stripX(scanAfter(mark.to_s))];
    const height = full * MARK_HEIGHT[mark.level];
    c.fillStyle = mark.level === "notice" ? colours.axis : colours[mark.level];
    c.fillRect(from - 1, y + full - height, Math.max(to - from, 3), height);
  }
  if (!state.timeline) return;
  c.fillStyle = colours.text;
  c.fillRect(stripX(state.timeline.index) - 1, 0, 2, 40);
}

function showHover(x) {
  const index = indexAt(x);
  const time = state.overview.times_s[index];
  const here = state.overview.marks.filter((one) => scanAfter(one.from_s) <= index && index <= scanAfter(one.to_s) && one.level !== "notice");
  byId("hover").textContent = [`${time.toFixed(1)} s`, ...here.slice(0, 2).map((one) => one.title), here.length > 2 ? `${here.length - 2} more` : ""].filter(Boolean).join(" · ");
  byId("hover").style.left = `${stripX(index)}px`;
  byId("hover").hidden = false;
  return index;
}

function listenToStrip() {
  const strip = byId("strip");
  let dragged = null;
  const seekTo = (x) => {
    const index = showHover(x);
    if (index !== dragged) send({ type: "seek", index });
    dragged = index;
  };
  strip.addEventListener("pointerdown", (event) => {
    if (!state.overview) return;
    strip.setPointerCapture(event.pointerId);
    dragged = -1;
    seekTo(event.offsetX);
  });
  for (const part of [strip, byId("seek")]) {
    part.addEventListener("pointermove", (event) => {
      if (!state.overview) return;
      const x = event.clientX - strip.getBoundingClientRect().left;
      if (part === strip && dragged !== null) seekTo(x);
      else showHover(x);
    });
    part.addEventListener("pointerleave", () => { byId("hover").hidden = true; });
  }
  for (const end of ["pointerup", "pointercancel"]) strip.addEventListener(end, () => { dragged = null; });
}

// To where a warning begins, after or before the shown scan.
function jump(direction) {
  if (!state.overview || !state.timeline) return;
  const starts = state.overview.marks.filter((one) => one.level !== "notice").map((one) => scanAfter(one.from_s));
  const { index } = state.timeline;
  const there = direction > 0 ? starts.filter((at) => at > index) : starts.filter((at) => at < index);
  if (there.length) send({ type: "seek", index: direction > 0 ? Math.min(...there) : Math.max(...there) });
}

function toggleLoop() {
  if (!state.timeline) return;
  state.loop = state.timeline.playing ? !state.timeline.loop : !state.loop;
  byId("loop").setAttribute("aria-pressed", state.loop);
  if (state.timeline.playing) play();
}

function play() {
  send({ type: "play", speed: Number(byId("speed").value), loop: state.loop });
}

function setLabel(id, key, text) {
  const kbd = document.createElement("kbd");
  kbd.textContent = key;
  byId(id).replaceChildren(kbd, ` ${text}`);
}

// --- the bird's-eye view ---------------------------------------------------------------------------------------------
// x forward is up, y left is to the left. Positions are CSS pixels of the canvas.

const bev = byId("bev");

function toCanvas(x, y) {
  return [bev.clientWidth / 2 - camera.scale * (y - camera.y), bev.clientHeight / 2 - camera.scale * (x - camera.x)];
}

function toWorld(px, py) {
  return [camera.x - (py - bev.clientHeight / 2) / camera.scale, camera.y - (px - bev.clientWidth / 2) / camera.scale];
}

function fit(always) {
  const limits = limitsOf(state.view);
  const old = camera.fitted;
  // small changes must not make the picture jump
  const same = old && limits.every((value, i) => Math.abs(value - old[i]) < 6);
  if (same && !always) return;
  camera.fitted = limits;
  const [front, left, right, back] = limits;
  camera.x = (front + back) / 2;
  camera.y = (left + right) / 2;
  camera.scale = Math.min(bev.clientHeight / (front - back), bev.clientWidth / (left - right));
  camera.free = false;
  dirty.bev = true;
}

function limitsOf(view) {
  const xs = [0, 20];
  const ys = [10, -10];
  const add = (x, y) => { xs.push(x); ys.push(y); };
  if (view) {
    for (let i = 0; i < view.los.length; i += 2) add(view.los[i], view.los[i + 1]);
    for (const [x, y, ix, iy] of view.points) { add(x, y); add(ix, iy); }
    for (const { ends } of view.walls) { add(ends[0], ends[1]); add(ends[2], ends[3]); }
    for (const { at } of view.tracks.slice(0, LABELLED_TRACKS)) if (Math.hypot(...at) < 110) add(...at);
    for (const { line } of (view.truth || { surfaces: [] }).surfaces) for (let i = 0; i < line.length; i += 2) add(line[i], line[i + 1]);
  }
  return [Math.min(quantile(xs, 0.98) + 4, 115), quantile(ys, 0.98) + 4, quantile(ys, 0.02) - 4, -4];
}

function quantile(values, share) {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted[Math.round(share * (sorted.length - 1))];
}

function prepare(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  context.font = "12px system-ui, 'Segoe UI', 'Noto Sans', 'DejaVu Sans', sans-serif";
  return context;
}

// Upon the map, which is dark, everything is drawn as in the dark.
function drawBev() {
  const page = colours;
  bev.dataset.theme = state.layers.map ? "dark" : state.theme;
  colours = coloursOf(bev);
  paintBev(prepare(bev));
  colours = page;
}

function paintBev(c) {
  c.fillStyle = colours.unknown;
  c.fillRect(0, 0, bev.clientWidth, bev.clientHeight);
  const { view, layers } = state;
  if (view && layers.mask && state.mask) drawMask(c, view.mask);
  if (layers.map && state.tile) drawMapBeneath(c);
  if (layers.grid) drawGrid(c);
  if (layers.lidar && state.lidar) drawLidar(c, state.lidar.tile);
  if (view) {
    if (layers.truth && view.truth) drawTruth(c, view.truth);
    if (layers.walls) view.walls.forEach(({ ends }) => stroke(c, ends, colours.wall, 4));
    if (layers.images) drawImages(c, view.points);
    if (layers.los) for (let i = 0; i < view.los.length; i += 2) drawDot(c, ...toCanvas(view.los[i], view.los[i + 1]), 3);
    if (layers.tracks) drawTracks(c, view);
    if (layers.objects) drawObjects(c, view);
    drawLabels(c, view);
  }
  drawEgo(c, view && view.vehicle);
  drawScaleBar(c);
}

function drawLidar(c, { cells, step }) {
  c.fillStyle = colours.lidar;
  const side = Math.max(2.5, step * camera.scale);
  for (let i = 0; i < cells.length; i += 2) {
    const [px, py] = toCanvas(cells[i] * step, cells[i + 1] * step);
    c.fillRect(px - side / 2, py - side / 2, side, side);
  }
}

function drawMask(c, grid) {
  if (!state.maskImage) state.maskImage = maskImage(state.mask);
  drawInWorld(c, state.maskImage, grid.x_min, grid.y_min, grid.cell, grid.cell, false);
}

function maskImage({ rows, columns, cells }) {
  const image = new OffscreenCanvas(columns, rows);
  const context = image.getContext("2d");
  const pixels = context.createImageData(columns, rows);
  const shades = [[0, 0, 0, 0], rgba(colours.direct), rgba(colours.mirrored), rgba(colours.hatch)];
  // seen in a mirror is hatched: told from direct sight without colours
  for (let i = 0; i < cells.length; i += 1) {
    const hatched = cells[i] === 2 && (i % columns + Math.floor(i / columns)) % 4 === 0;
    pixels.data.set(shades[cells[i] + hatched], 4 * i);
  }
  context.putImageData(pixels, 0, 0);
  return image;
}

// Draws an image whose columns run along x and rows along y, from their minimum.
function drawInWorld(c, image, x, y, cellX, cellY, smooth) {
  const ratio = window.devicePixelRatio || 1;
  const [px, py] = toCanvas(x, y);
  c.save();
  c.imageSmoothingEnabled = smooth;
  c.setTransform(0, -camera.scale * cellX * ratio, -camera.scale * cellY * ratio, 0, px * ratio, py * ratio);
  c.drawImage(image, 0, 0);
  c.restore();
}

function niceStep(minimum) {
  const power = 10 ** Math.floor(Math.log10(minimum));
  return [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= minimum);
}

function drawGrid(c) {
  const step = niceStep(60 / camera.scale);
  const [xMax, yMax] = toWorld(0, 0);
  const [xMin, yMin] = toWorld(bev.clientWidth, bev.clientHeight);
  c.strokeStyle = colours.grid;
  c.lineWidth = 1;
  c.beginPath();
  for (let x = Math.ceil(xMin / step) * step; x <= xMax; x += step) line(c, [...toCanvas(x, yMax)], [...toCanvas(x, yMin)]);
  for (let y = Math.ceil(yMin / step) * step; y <= yMax; y += step) line(c, [...toCanvas(xMin, y)], [...toCanvas(xMax, y)]);
  c.stroke();
  c.fillStyle = colours.axis;
  c.textAlign = "left";
  for (let x = Math.ceil(xMin / step) * step; x <= xMax; x += step) {
    const py = toCanvas(x, 0)[1];
    if (py > 24 && py < bev.clientHeight - 24) caption(c, `${Number(x.toFixed(3))}`, 6, py + 4);
  }
  c.textAlign = "center";
  for (let y = Math.ceil(yMin / step) * step; y <= yMax; y += step) {
    const px = toCanvas(0, y)[0];
    if (px > 40 && px < bev.clientWidth - 90) caption(c, `${Number(y.toFixed(3))}`, px, bev.clientHeight - 6);
  }
  c.textAlign = "left";
  caption(c, "x forward [m]", 6, 14);
  c.textAlign = "right";
  caption(c, "y left [m]", bev.clientWidth - 8, bev.clientHeight - 6);
}

// Text that stays legible upon lines and shades.
function caption(c, text, px, py) {
  Object.assign(c, { strokeStyle: colours.label, lineWidth: 3, lineJoin: "round" });
  c.strokeText(text, px, py);
  c.fillText(text, px, py);
}

function line(c, from, to) {
  c.moveTo(Math.round(from[0]) + 0.5, Math.round(from[1]) + 0.5);
  c.lineTo(Math.round(to[0]) + 0.5, Math.round(to[1]) + 0.5);
}

function stroke(c, flat, colour, width, dash = []) {
  c.beginPath();
  for (let i = 0; i < flat.length; i += 2) c.lineTo(...toCanvas(flat[i], flat[i + 1]));
  Object.assign(c, { strokeStyle: colour, lineWidth: width, lineCap: "round", lineJoin: "round" });
  c.setLineDash(dash);
  c.stroke();
  c.setLineDash([]);
}

function cornersOf({ at, centre = at, size, yaw }) {
  const [cos, sin] = [Math.cos(yaw), Math.sin(yaw)];
  return [[1, 1], [-1, 1], [-1, -1], [1, -1]].map(([u, v]) => {
    const [dx, dy] = [(u * size[0]) / 2, (v * size[1]) / 2];
    return [centre[0] + cos * dx - sin * dy, centre[1] + sin * dx + cos * dy];
  });
}

function box(c, one) {
  c.beginPath();
  for (const corner of cornersOf(one)) c.lineTo(...toCanvas(...corner));
  c.closePath();
}

function drawDot(c, px, py, radius) {
  c.beginPath();
  c.arc(px, py, radius, 0, 2 * Math.PI);
  Object.assign(c, { fillStyle: colours.los, strokeStyle: colours["los-edge"], lineWidth: 1 });
  c.fill();
  c.stroke();
}

function drawDiamond(c, px, py, radius, fill = true) {
  c.beginPath();
  for (const [dx, dy] of [[0, -1], [1, 0], [0, 1], [-1, 0]]) c.lineTo(px + radius * dx, py + radius * dy);
  c.closePath();
  Object.assign(c, { fillStyle: colours.unknown, strokeStyle: colours.image, lineWidth: 1.8 });
  if (fill) c.fill();
  c.stroke();
}

function drawImages(c, points) {
  c.globalAlpha = 0.75;
  for (const [x, y, ix, iy] of points) stroke(c, [ix, iy, x, y], colours.image, 1);
  c.globalAlpha = 1;
  for (const [x, y, ix, iy] of points) {
    drawDiamond(c, ...toCanvas(ix, iy), 5);
    const [px, py] = toCanvas(x, y);
    c.beginPath();
    c.moveTo(px - 4, py - 4); c.lineTo(px + 4, py + 4); c.moveTo(px - 4, py + 4); c.lineTo(px + 4, py - 4);
    Object.assign(c, { strokeStyle: colours.place, lineWidth: 1.6 });
    c.stroke();
  }
}

function drawObjects(c, view) {
  for (const one of view.objects) {
    box(c, one);
    Object.assign(c, { fillStyle: colours["object-fill"], strokeStyle: colours.object, lineWidth: 2.4 });
    c.fill();
    c.stroke();
    drawEllipse(c, one.at, one.ellipse, colours.sigma);
  }
}

function drawTracks(c, view) {
  const warned = new Set(currentWarnings().filter((one) => one.level === "urgent").flatMap((one) => one.tracks));
  for (const one of view.tracks) {
    // what may not be there any more fades; recordings of before say how often it was missed instead
    c.globalAlpha = Math.max(one.existence ?? 1 - one.misses / 6, 0.25);
    drawTrail(c, one);
    drawWay(c, one);
    drawEllipse(c, one.at, one.ellipse, colours.track);
    drawTrackDot(c, one, warned.has(one.id));
    c.globalAlpha = 1;
  }
}

// Where it was, over ground: the older the smaller.
function drawTrail(c, { trail }) {
  if (trail.length < 4) return;
  const alpha = c.globalAlpha;
  c.globalAlpha = 0.5 * alpha;
  stroke(c, trail, colours.track, 1.5);
  c.globalAlpha = alpha;
  c.fillStyle = colours.track;
  for (let i = 0; i < trail.length - 2; i += 2) {
    c.beginPath();
    c.arc(...toCanvas(trail[i], trail[i + 1]), 1 + (2 * i) / trail.length, 0, 2 * Math.PI);
    c.fill();
  }
}

// Where it comes into direct sight if it goes on so; null where it does not, or hardly moves.
function wayEnd({ at, velocity, appears_s: appears }) {
  if (appears === null || appears <= 0 || Math.hypot(...velocity) < SLOW_MPS) return null;
  return [at[0] + appears * velocity[0], at[1] + appears * velocity[1]];
}

function drawWay(c, one) {
  const end = wayEnd(one);
  if (end) {
    stroke(c, [...one.at, ...end], colours.track, 2, [7, 5]);
    c.beginPath();
    c.arc(...toCanvas(...end), 6, 0, 2 * Math.PI);
    Object.assign(c, { strokeStyle: colours.track, lineWidth: 2.5 });
    c.stroke();
  }
  if (speedOf(one) < SLOW_MPS) return;
  const tip = [one.at[0] + one.velocity[0], one.at[1] + one.velocity[1]];
  stroke(c, [...one.at, ...tip], colours.track, 3);
  const [px, py] = toCanvas(...tip);
  const [qx, qy] = toCanvas(...one.at);
  const angle = Math.atan2(py - qy, px - qx);
  c.beginPath();
  for (const turn of [0, 2.6, -2.6]) c.lineTo(px + 9 * Math.cos(angle + turn), py + 9 * Math.sin(angle + turn));
  c.closePath();
  c.fillStyle = colours.track;
  c.fill();
  if (one.velocity_ellipse) drawEllipse(c, tip, one.velocity_ellipse, colours.track, 1, [1, 4]);
}

// A dot, or at the edge of the picture an arrowhead towards where it would be.
function drawTrackDot(c, one, warned) {
  const [x, y] = toCanvas(...one.at);
  const [px, py] = [Math.min(Math.max(x, 10), bev.clientWidth - 10), Math.min(Math.max(y, 10), bev.clientHeight - 10)];
  c.fillStyle = colours.track;
  c.beginPath();
  if (px === x && py === y) {
    c.arc(x, y, 5, 0, 2 * Math.PI);
  } else {
    const angle = Math.atan2(y - py, x - px);
    for (const turn of [0, 2.4, -2.4]) c.lineTo(px + 9 * Math.cos(angle + turn), py + 9 * Math.sin(angle + turn));
  }
  c.fill();
  if (!warned) return;
  for (const [colour, width] of [[colours.label, 6], [colours.urgent, 3]]) {
    c.beginPath();
    c.arc(px, py, 13, 0, 2 * Math.PI);
    Object.assign(c, { strokeStyle: colour, lineWidth: width });
    c.stroke();
  }
}

function drawEllipse(c, at, [major, minor, angle], colour, width = 1.2, dash = [4, 3]) {
  const points = [];
  for (let i = 0; i <= 48; i += 1) {
    const t = (2 * Math.PI * i) / 48;
    const [u, v] = [major * Math.cos(t), minor * Math.sin(t)];
    points.push(at[0] + u * Math.cos(angle) - v * Math.sin(angle), at[1] + u * Math.sin(angle) + v * Math.cos(angle));
  }
  stroke(c, points, colour, width, dash);
}

// Beside the box that it names, where neither another box nor a label stands; if need be further off, with a line to it.
function drawLabel(c, box, text, colour, taken) {
  const [left, top, right, bottom] = box;
  const [x, y, width, height] = [(left + right) / 2, (top + bottom) / 2, c.measureText(text).width + 12, 20];
  if (x < 0 || y < 0 || x > bev.clientWidth || y > bev.clientHeight) return;
  const within = Math.min(Math.max(x - width / 2, 1), bev.clientWidth - width - 1);
  const spots = [3, 26, 49, 72, 95].flatMap((gap) => [
    [within, top - gap - height], [within, bottom + gap], [right + gap, y - height / 2], [left - gap - width, y - height / 2],
  ]).map(([u, v]) => [u, v, u + width, v + height]);
  const isFree = (spot) => spot[0] > 0 && spot[1] > 0 && spot[2] < bev.clientWidth && spot[3] < bev.clientHeight && !taken.some((other) => overlap(spot, other));
  const spot = spots.find(isFree) || spots[0];
  taken.push(spot);
  state.labels.push({ text, box, spot });
  c.beginPath();
  if (spots.indexOf(spot) > 3) {
    c.moveTo(Math.min(Math.max(x, spot[0]), spot[2]), Math.min(Math.max(y, spot[1]), spot[3]));
    c.lineTo(Math.min(Math.max(x, left), right), Math.min(Math.max(y, top), bottom));
  }
  c.roundRect(spot[0], spot[1], width, height, 4);
  Object.assign(c, { fillStyle: colours.label, strokeStyle: colour, lineWidth: 1, textAlign: "left" });
  c.fill();
  c.stroke();
  c.fillStyle = colours.text;
  c.fillText(text, spot[0] + 6, spot[1] + 14);
}

const overlap = (a, b) => a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];

// What a box in the plane, or a dot, takes of the canvas.
function boundsOf(corners, margin = 2) {
  const points = corners.map((corner) => toCanvas(...corner));
  const [xs, ys] = [points.map(([x]) => x), points.map(([, y]) => y)];
  return [Math.min(...xs) - margin, Math.min(...ys) - margin, Math.max(...xs) + margin, Math.max(...ys) + margin];
}

function drawLabels(c, { objects, tracks }) {
  const [boxes, dots] = [state.layers.objects ? objects : [], state.layers.tracks ? tracks.slice(0, LABELLED_TRACKS) : []];
  const taken = boxes.map((one) => boundsOf(cornersOf(one)));
  state.labels = [];
  for (const one of boxes) drawLabel(c, boundsOf(cornersOf(one)), `${objectName(one)}  ${one.score.toFixed(2)}`, colours.object, taken);
  for (const one of dots) {
    const [end, text] = [wayEnd(one), `T${one.id}  ${(3.6 * speedOf(one)).toFixed(0)} km/h`];
    if (end) drawLabel(c, boundsOf([end], 9), sightText(one), colours.track, taken);
    drawLabel(c, boundsOf([one.at], 8), end || one.appears_s === null ? text : `${text}, in sight ${sightText(one)}`, colours.track, taken);
  }
}

function drawTruth(c, truth) {
  for (const { line: flat, role } of truth.surfaces) stroke(c, flat, colours.surface, 1.5, role === "ground" ? [2, 4] : []);
  for (const one of truth.objects) {
    box(c, one);
    Object.assign(c, { strokeStyle: one.hidden ? colours.truth : colours["truth-seen"], lineWidth: 2 });
    c.stroke();
    const [vx, vy] = one.velocity;
    if (Math.hypot(vx, vy) > 0.1) stroke(c, [...one.at, one.at[0] + vx, one.at[1] + vy], colours.truth, 1.5);
  }
}

// The sensor, and where its vehicle will be in two seconds if it goes on as it does.
function drawEgo(c, vehicle) {
  if (vehicle && vehicle.valid && Math.abs(vehicle.speed_mps) > 0.05) {
    const points = [];
    for (let i = 0; i <= 20; i += 1) {
      const yaw = (vehicle.yaw_rate_rps * i) / 10;
      const chord = ((vehicle.speed_mps * i) / 10) * (Math.abs(yaw) > 1e-9 ? Math.sin(yaw / 2) / (yaw / 2) : 1);
      points.push(chord * Math.cos(yaw / 2), chord * Math.sin(yaw / 2));
    }
    stroke(c, points, colours.ego, 2, [6, 4]);
  }
  const [px, py] = toCanvas(0, 0);
  c.beginPath();
  c.moveTo(px, py - 9); c.lineTo(px + 8, py + 7); c.lineTo(px, py + 3); c.lineTo(px - 8, py + 7);
  c.closePath();
  c.fillStyle = colours.ego;
  c.fill();
  c.textAlign = "left";
  const name = state.sensor ? state.sensor.name : "radar";
  const words = !vehicle ? name : !vehicle.valid ? `${name}, motion unknown: ${vehicle.reason}`
    : `${name}, ${vehicle.speed_mps.toFixed(1)} m/s${Math.abs(vehicle.yaw_rate_rps) > 1e-3 ? `, ${((vehicle.yaw_rate_rps * 180) / Math.PI).toFixed(0)}°/s` : ""}`;
  caption(c, words, px + 13, py + 6);
}

function drawScaleBar(c) {
  const metres = niceStep(80 / camera.scale);
  const width = metres * camera.scale;
  const [right, y] = [bev.clientWidth - 16, 22];
  Object.assign(c, { strokeStyle: colours.text, lineWidth: 2, fillStyle: colours.text, textAlign: "center", lineCap: "butt" });
  c.beginPath();
  c.moveTo(right - width, y - 4); c.lineTo(right - width, y); c.lineTo(right, y); c.lineTo(right, y - 4);
  c.stroke();
  caption(c, `${metres} m`, right - width / 2, y - 7);
}

// --- the range-azimuth map -------------------------------------------------------------------------------------------

function colourRamp(anchors) {
  const stops = anchors.map(rgba);
  const table = new Uint8ClampedArray(4 * 256);
  for (let i = 0; i < 256; i += 1) {
    const at = (i / 255) * (stops.length - 1);
    const low = Math.min(Math.floor(at), stops.length - 2);
    for (let k = 0; k < 3; k += 1) table[4 * i + k] = stops[low][k] + (at - low) * (stops[low + 1][k] - stops[low][k]);
    table[4 * i + 3] = 255;
  }
  return table;
}

function rgba(hex) {
  const digits = hex.trim().slice(1);
  return [0, 2, 4, 6].map((at) => (at < digits.length ? parseInt(digits.slice(at, at + 2), 16) : 255));
}

// Levels from the lowest to the highest colour. Noise alone must look like noise: dark. An echo must not, however bright
// a wall at hand is: of photons, which have few levels, all are shown.
function levelWindow() {
  if (state.map.reference !== "noise") return [-DYNAMIC_RANGE_DB, 0];
  const top = Math.max(Math.ceil(state.map.peak_db / 5) * 5, LEAST_TOP_DB);
  return [state.map.mode === "photons" ? 0 : NOISE_TOP_DB, top];
}

// Share of the colour scale at a level: weak levels get more of it than strong ones.
function shareAt(level, [low, high]) {
  return Math.min(Math.max((level - low) / (high - low), 0), 1) ** 0.4;
}

// Colour of each code of a tile within the window of levels.
function codeColours({ floor, step }) {
  const levels = levelWindow();
  const table = new Uint8ClampedArray(4 * 256);
  for (let code = 0; code < 256; code += 1) {
    const at = 4 * Math.round(255 * shareAt(floor + step * code, levels));
    table.set(ramp.subarray(at, at + 4), 4 * code);
  }
  return table;
}

// Level of the tile at a range and an azimuth, interpolated between its cells; null outside the sector.
function sampler(map, tile) {
  const limit = (map.azimuth_limit_deg * Math.PI) / 180;
  const azimuthStep = (2 * limit) / (map.azimuth_bins - 1);
  const [poolRows, poolColumns] = map.pool;
  const { rows, columns, cells } = tile;
  return (range, azimuth) => {
    if (Math.abs(azimuth) > limit) return null;
    const r = (range / map.range_bin_m - (poolRows - 1) / 2) / poolRows;
    if (r > rows - 0.5) return null;
    const a = ((azimuth + limit) / azimuthStep - (poolColumns - 1) / 2) / poolColumns;
    const r0 = Math.min(Math.max(Math.floor(r), 0), rows - 1);
    const a0 = Math.min(Math.max(Math.floor(a), 0), columns - 1);
    const r1 = Math.min(r0 + 1, rows - 1);
    const a1 = Math.min(a0 + 1, columns - 1);
    const fr = Math.min(Math.max(r - r0, 0), 1);
    const fa = Math.min(Math.max(a - a0, 0), 1);
    const near = cells[r0 * columns + a0] * (1 - fa) + cells[r0 * columns + a1] * fa;
    const far = cells[r1 * columns + a0] * (1 - fa) + cells[r1 * columns + a1] * fa;
    return near * (1 - fr) + far * fr;
  };
}

function paint(width, height, levelAt) {
  const image = new OffscreenCanvas(width, height);
  const context = image.getContext("2d");
  const pixels = context.createImageData(width, height);
  const table = codeColours(state.tile);
  for (let v = 0, at = 0; v < height; v += 1) {
    for (let u = 0; u < width; u += 1, at += 4) {
      const level = levelAt(u, v);
      if (level !== null) pixels.data.set(table.subarray(4 * Math.round(level), 4 * Math.round(level) + 4), at);
    }
  }
  context.putImageData(pixels, 0, 0);
  return image;
}

// The map in the plane: columns run along x, rows along y, so many along x.
const PLANE_CELLS = 400;
function planeImage() {
  if (!state.planeImage || state.planeReach !== state.reach) {
    const level = sampler(state.map, state.tile);
    const side = state.reach * Math.sin((state.map.azimuth_limit_deg * Math.PI) / 180);
    const cell = state.reach / PLANE_CELLS;
    const [width, height] = [PLANE_CELLS, 2 * Math.ceil(side / cell)];
    state.planeImage = paint(width, height, (u, v) => {
      const x = (u + 0.5) * cell;
      const y = (v + 0.5 - height / 2) * cell;
      const range = Math.hypot(x, y);
      return range > state.reach ? null : level(range, Math.atan2(y, x));
    });
    state.planeReach = state.reach;
    state.planeCell = cell;
    state.planeSide = (height / 2) * cell;
  }
  return state.planeImage;
}

function drawMapBeneath(c) {
  const image = planeImage();
  c.globalAlpha = 0.85;
  drawInWorld(c, image, 0, -state.planeSide, state.planeCell, state.planeCell, true);
  c.globalAlpha = 1;
}

function drawMap() {
  const canvas = byId("map");
  const c = prepare(canvas);
  if (!state.map || !state.tile) return;
  const area = { x: 30, y: 8, width: canvas.clientWidth - 30 - 76, height: canvas.clientHeight - 8 - 24 };
  if (state.form === "polar") drawPolar(c, area);
  else drawPlane(c, area);
  drawColourBar(c, canvas.clientWidth - 58, 8, 12, canvas.clientHeight - 40);
}

function drawPolar(c, area) {
  const { map, tile, reach } = state;
  const limit = map.azimuth_limit_deg;
  const level = sampler(map, tile);
  const [width, height] = [Math.round(area.width), Math.round(area.height)];
  if (!state.polarImage || state.polarReach !== reach) {
    state.polarImage = paint(width, height, (u, v) =>
      level(reach * (1 - (v + 0.5) / height), ((1 - (2 * (u + 0.5)) / width) * limit * Math.PI) / 180));
    state.polarReach = reach;
  }
  c.fillStyle = state.colours[0];
  c.fillRect(area.x, area.y, area.width, area.height);
  c.drawImage(state.polarImage, area.x, area.y, area.width, area.height);
  mapToCanvas = (range, azimuth) => [
    area.x + area.width * (0.5 - (azimuth * 180) / Math.PI / limit / 2), area.y + area.height * (1 - range / reach),
  ];
  drawPeaks(c);
  drawTicks(c, area, [-60, -30, 0, 30, 60].filter((value) => Math.abs(value) <= limit), (value) => mapToCanvas(0, (value * Math.PI) / 180)[0], "°", (value) => mapToCanvas(value, 0)[1]);
}

function drawPlane(c, area) {
  const { reach, map } = state;
  const side = reach * Math.sin((map.azimuth_limit_deg * Math.PI) / 180);
  const scale = Math.min(area.width / (2 * side), area.height / reach);
  const [cx, cy] = [area.x + area.width / 2, area.y + area.height];
  const image = planeImage();
  const ratio = window.devicePixelRatio || 1;
  c.save();
  c.setTransform(0, -scale * state.planeCell * ratio, -scale * state.planeCell * ratio, 0, (cx + scale * state.planeSide) * ratio, cy * ratio);
  c.drawImage(image, 0, 0);
  c.restore();
  mapToCanvas = (range, azimuth) => [cx - scale * range * Math.sin(azimuth), cy - scale * range * Math.cos(azimuth)];
  drawPeaks(c);
  const step = reach / 2;
  drawTicks(c, area, [-1, 0, 1].map((k) => k * step).filter((y) => Math.abs(y) <= side), (y) => cx - scale * y, "", (x) => cy - scale * x);
}

function drawPeaks(c) {
  for (const [range, azimuth, mirrored] of state.map.peaks || []) {
    if (range > state.reach) continue;
    const [px, py] = mapToCanvas(range, azimuth);
    if (mirrored) {
      c.strokeStyle = "#ffb000";
      c.lineWidth = 1.6;
      c.beginPath();
      for (const [dx, dy] of [[0, -5], [5, 0], [0, 5], [-5, 0]]) c.lineTo(px + dx, py + dy);
      c.closePath();
    } else {
      c.strokeStyle = "#7fd0ff";
      c.lineWidth = 1.4;
      c.beginPath();
      c.arc(px, py, 4, 0, 2 * Math.PI);
    }
    c.stroke();
  }
}

function drawTicks(c, area, across, acrossAt, unit, upAt) {
  c.fillStyle = colours.axis;
  c.textAlign = "center";
  for (const value of across) c.fillText(`${Math.round(value)}${unit}`, acrossAt(value), area.y + area.height + 16);
  c.textAlign = "right";
  for (const share of [0, 0.5, 1]) {
    c.fillText(`${Math.round(share * state.reach)}`, area.x - 6, Math.max(upAt(share * state.reach), area.y + 8) + (share ? 4 : 0));
  }
  c.textAlign = "left";
  c.fillText("m", 2, area.y + area.height + 16);
}

function drawColourBar(c, x, y, width, height) {
  const [low, high] = levelWindow();
  for (let i = 0; i < height; i += 1) {
    const at = 4 * Math.round(255 * (1 - i / (height - 1)));
    c.fillStyle = `rgb(${ramp[at]}, ${ramp[at + 1]}, ${ramp[at + 2]})`;
    c.fillRect(x, y + i, width, 1.5);
  }
  c.fillStyle = colours.axis;
  c.textAlign = "left";
  let above = Infinity;
  for (let level = Math.ceil(low / 10) * 10; level <= high; level += 10) {
    const at = Math.min(Math.max(y + height * (1 - shareAt(level, [low, high])), y + 6), y + height - 2);
    if (above - at < 12) continue;
    above = at;
    c.fillText(`${level}`, x + width + 5, at + 4);
  }
  c.save();
  c.translate(x + width + 38, y + height / 2);
  c.rotate(-Math.PI / 2);
  c.textAlign = "center";
  c.fillText(state.map.unit, 0, 0);
  c.restore();
}

// --- swatches --------------------------------------------------------------------------------------------------------

function drawSwatch({ key, swatch, more = [] }) {
  const canvases = byId(`layer-${key}`).parentElement.querySelectorAll("canvas");
  [swatch, more[1]].slice(0, canvases.length).forEach((draw, i) => {
    Object.assign(canvases[i], { width: 44, height: 32 });
    const c = canvases[i].getContext("2d");
    c.setTransform(2, 0, 0, 2, 0, 0);
    draw(c);
  });
}

function plain(c, colour, width, points) {
  c.beginPath();
  for (let i = 0; i < points.length; i += 2) c.lineTo(points[i], points[i + 1]);
  Object.assign(c, { strokeStyle: colour, lineWidth: width });
  c.stroke();
}

function drawMaskSwatch(c, kind) {
  const image = maskImage({ rows: 12, columns: 20, cells: new Uint8Array(240).fill(kind) });
  c.drawImage(image, 1, 2);
  Object.assign(c, { strokeStyle: colours.surface, lineWidth: 0.75 });
  c.strokeRect(1, 2, 20, 12);
}

function drawWallSwatch(c) { plain(c, colours.wall, 4, [2, 8, 20, 8]); }

function drawObjectSwatch(c) {
  Object.assign(c, { fillStyle: colours["object-fill"], strokeStyle: colours.object, lineWidth: 2 });
  c.fillRect(2, 3, 18, 10);
  c.strokeRect(2, 3, 18, 10);
}

function drawTruthSwatch(c) {
  Object.assign(c, { strokeStyle: colours.truth, lineWidth: 2 });
  c.strokeRect(2, 3, 18, 10);
}

function drawMapSwatch(c) {
  const gradient = c.createLinearGradient(1, 0, 21, 0);
  (state.colours.length ? state.colours : ["#00224e", "#fee838"]).forEach((colour, i, all) => gradient.addColorStop(i / (all.length - 1), colour));
  c.fillStyle = gradient;
  c.fillRect(1, 2, 20, 12);
}

function drawTrackSwatch(c) {
  plain(c, colours.track, 2, [2, 8, 14, 8]);
  c.fillStyle = colours.track;
  c.beginPath();
  c.arc(15, 8, 4, 0, 2 * Math.PI);
  c.fill();
}

function drawLidarSwatch(c) {
  c.fillStyle = colours.lidar;
  for (const [x, y] of [[2, 4], [6, 5], [10, 6], [14, 7], [18, 8], [17, 12]]) c.fillRect(x, y, 2, 2);
}

function drawGridSwatch(c) {
  for (const at of [4, 9, 14, 19]) plain(c, colours.axis, 0.75, [at, 1, at, 15]);
  for (const at of [3, 8, 13]) plain(c, colours.axis, 0.75, [1, at, 21, at]);
}

// --- what people do --------------------------------------------------------------------------------------------------

function setPaused(paused) {
  state.paused = paused;
  byId("pause").setAttribute("aria-pressed", paused);
  setLabel("pause", "space", paused ? "Resume" : "Pause");
  if (!paused) {
    if (state.held.view) showView(state.held.view);
    if (state.held.map) showMap(state.held.map);
    for (const kind of Object.keys(SHOW_SIDE)) if (state.held[kind]) SHOW_SIDE[kind](state.held[kind]);
    state.held = { view: null, map: null, lidar: null, image: null };
  } else {
    state.missed = 0;
  }
  showFigures();
}

function togglePlay() {
  if (!state.recording) return setPaused(!state.paused);
  if (state.timeline && state.timeline.playing) return send({ type: "play", speed: 0 });
  return play();
}

function stepBy(by) {
  if (state.recording) send({ type: "step", by });
}

function setLayer(key, on) {
  state.layers[key] = on;
  byId(`layer-${key}`).checked = on;
  remember("layers", JSON.stringify(state.layers));
  if (key === "map") state.maskImage = null;
  dirty.bev = true;
}

function setForm(form) {
  state.form = form;
  byId("form-cartesian").setAttribute("aria-pressed", form === "cartesian");
  byId("form-polar").setAttribute("aria-pressed", form === "polar");
  state.polarImage = null;
  dirty.map = true;
}

function setTheme(theme) {
  state.theme = theme;
  document.documentElement.dataset.theme = theme;
  byId("theme-name").textContent = theme === "dark" ? "Light" : "Dark";
  colours = coloursOf(document.documentElement);
  state.maskImage = null;
  for (const layer of LAYERS) drawSwatch(layer);
  drawStrip();
  buildPlots();
  dirty = { bev: true, map: true, camera: true };
}

function coloursOf(element) {
  const style = getComputedStyle(element);
  return Object.fromEntries(COLOUR_NAMES.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

function zoom(factor, px = bev.clientWidth / 2, py = bev.clientHeight / 2) {
  const before = toWorld(px, py);
  camera.scale = Math.min(Math.max(camera.scale * factor, 1), 400);
  const after = toWorld(px, py);
  move(before[0] - after[0], before[1] - after[1]);
}

function move(dx, dy) {
  camera.x += dx;
  camera.y += dy;
  camera.free = true;
  dirty.bev = true;
}

// Layout is kept for this page's origin; where storage is refused the page works without.
function remember(key, value) {
  try { localStorage.setItem(`mirrorwave.${key}`, value); } catch { /* private window */ }
}

function recall(key) {
  try { return localStorage.getItem(`mirrorwave.${key}`); } catch { return null; }
}

const ARROWS = { ArrowUp: [1, 0], ArrowDown: [-1, 0], ArrowLeft: [0, 1], ArrowRight: [0, -1] };
const KEYS = {
  " ": togglePlay, f: () => fit(true), t: toggleTheme, "?": () => byId("help").showModal(),
  r: () => setForm(state.form === "polar" ? "cartesian" : "polar"),
  n: () => jump(1), p: () => jump(-1), l: toggleLoop, s: toggleSound,
  ",": () => stepBy(-1), ".": () => stepBy(1), "+": () => zoom(1.25), "=": () => zoom(1.25), "-": () => zoom(0.8),
};

function toggleTheme() {
  setTheme(state.theme === "dark" ? "light" : "dark");
  remember("theme", state.theme);
}

function onKey(event) {
  const { target, key } = event;
  if (event.ctrlKey || event.altKey || event.metaKey || byId("help").open) return;
  // space and arrows belong to the control that has the focus
  const control = target instanceof Element && target.closest("button, input, select, a");
  if (control && control.id === "seek") {
    if (key in ARROWS || key === "Home" || key === "End") return;
  } else if (control && (key === " " || key in ARROWS || key === "Enter")) return;
  if (control && control.tagName === "SELECT") return;
  const layer = LAYERS[(Number(key) + 9) % 10];
  if (/^[0-9]$/.test(key) && layer) setLayer(layer.key, !state.layers[layer.key]);
  else if (key in KEYS) KEYS[key]();
  else if (key in ARROWS && target === bev) move(...ARROWS[key].map((part) => (part * 60) / camera.scale));
  else if (key === "ArrowLeft" || key === "ArrowRight") stepBy((key === "ArrowLeft" ? -1 : 1) * (event.shiftKey ? 10 : 1));
  else if (state.recording && state.timeline && (key === "Home" || key === "End")) send({ type: "seek", index: key === "Home" ? 0 : state.timeline.count - 1 });
  else return;
  event.preventDefault();
}

function listenToPointer() {
  let from = null;
  bev.addEventListener("pointerdown", (event) => {
    from = [event.clientX, event.clientY];
    bev.setPointerCapture(event.pointerId);
    bev.classList.add("dragging");
  });
  bev.addEventListener("pointermove", (event) => {
    if (!from) return;
    move((event.clientY - from[1]) / camera.scale, (event.clientX - from[0]) / camera.scale);
    from = [event.clientX, event.clientY];
  });
  for (const end of ["pointerup", "pointercancel"]) {
    bev.addEventListener(end, () => { from = null; bev.classList.remove("dragging"); });
  }
  bev.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(-event.deltaY * 0.0015), event.offsetX, event.offsetY);
  }, { passive: false });
}

function buildLayers() {
  const kept = JSON.parse(recall("layers") || "{}");
  LAYERS.forEach((layer, index) => {
    if (typeof kept[layer.key] === "boolean") state.layers[layer.key] = kept[layer.key];
    const label = document.createElement("label");
    const input = Object.assign(document.createElement("input"), { type: "checkbox", id: `layer-${layer.key}`, checked: state.layers[layer.key] });
    const swatch = () => document.createElement("canvas");
    const kbd = Object.assign(document.createElement("kbd"), { textContent: (index + 1) % 10 });
    label.title = layer.hint || "";
    // shown with the first cloud
    label.hidden = layer.key === "lidar";
    label.append(input, kbd, swatch(), layer.name, ...(layer.more ? [swatch(), layer.more[0]] : []));
    label.append(Object.assign(document.createElement("span"), { id: `layer-${layer.key}-more` }));
    input.addEventListener("change", () => setLayer(layer.key, input.checked));
    byId("layers").append(label);
  });
}

function turn() {
  if (dirty.bev) { dirty.bev = false; drawBev(); }
  if (dirty.map) { dirty.map = false; drawMap(); }
  if (dirty.camera) { dirty.camera = false; drawCamera(); }
  requestAnimationFrame(turn);
}

function start() {
  buildLayers();
  startPlots();
  const darkWanted = matchMedia("(prefers-color-scheme: dark)");
  const theme = () => recall("theme") || (darkWanted.matches ? "dark" : "light");
  setTheme(theme());
  darkWanted.addEventListener("change", () => setTheme(theme()));
  listenToPointer();
  document.addEventListener("keydown", onKey);
  byId("pause").addEventListener("click", () => setPaused(!state.paused));
  byId("fit").addEventListener("click", () => fit(true));
  byId("theme").addEventListener("click", toggleTheme);
  byId("help-open").addEventListener("click", () => byId("help").showModal());
  byId("form-cartesian").addEventListener("click", () => setForm("cartesian"));
  byId("form-polar").addEventListener("click", () => setForm("polar"));
  byId("reach").addEventListener("change", (event) => {
    state.reach = Number(event.target.value);
    state.planeImage = null;
    dirty.bev = dirty.map = true;
  });
  byId("play").addEventListener("click", togglePlay);
  byId("back").addEventListener("click", () => stepBy(-1));
  byId("forward").addEventListener("click", () => stepBy(1));
  byId("seek").addEventListener("input", (event) => {
    soughtAt = performance.now();
    send({ type: "seek", index: Number(event.target.value) });
  });
  byId("event-back").addEventListener("click", () => jump(-1));
  byId("event-forward").addEventListener("click", () => jump(1));
  byId("loop").addEventListener("click", toggleLoop);
  byId("sound").addEventListener("click", toggleSound);
  listenToStrip();
  byId("speed").addEventListener("change", () => {
    if (state.timeline && state.timeline.playing) play();
  });
  const sized = new ResizeObserver(() => {
    if (!camera.free && state.view) fit(true);
    state.polarImage = null;
    dirty = { bev: true, map: true, camera: true };
  });
  sized.observe(bev);
  sized.observe(byId("camera"));
  sized.observe(byId("map"));
  new ResizeObserver(drawStrip).observe(byId("strip"));
  setInterval(showFigures, 200);
  setInterval(showWarnings, 1000);
  requestAnimationFrame(turn);
  connect();
}

// For tests and for whoever opens the console: what is shown, and the canvas's own scale.
window.mirrorwave = { state, plots, camera, freshness, toCanvas, toWorld, mapToCanvas: (range, azimuth) => mapToCanvas(range, azimuth), setPaused, setLayer, setForm, setTheme, fit };

start();
