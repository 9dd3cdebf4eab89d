// The page: asks for the next image, draws it, and sends what buttons and keys say.
"use strict";
const $ = id => document.getElementById(id);
const token = new URLSearchParams(location.search).get("token");
const MOST_POINTS = 20000;
const shown = new Set(["s0", "aop", "dolp"]);
const figures = {};
let large = null, region = null, drag = null, status = {}, after = 0, drawn = 0;
let trace = [], lastImage = null, lastValues = null, socket = null, asked = 0, colours = null,
  shownUs = null;

function address(path, values) {
  const query = new URLSearchParams(values);
  if (token) query.set("token", token);
  return path + "?" + query;
}

async function command(what, value) {
  try {
    const answer = await fetch(address("command", {}), {method: "POST",
      headers: {"Content-Type": "application/json"},
      body: JSON.stringify({do: what, value: value === undefined ? null : value})});
    const told = await answer.json();
    if (!answer.ok) throw new Error(told.error);
    say("");
    tell(told);
  } catch (error) { say(error.message); }
}

function say(text) { $("said").textContent = text; }

// ---- images -----------------------------------------------------------------------

// One image is asked for at a time: a page that is slow gets fewer, and none late.
function follow() {
  const where = new URL(address("images", {}), location.href);
  where.protocol = location.protocol === "https:" ? "wss:" : "ws:";
  socket = new WebSocket(where);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => { asked = 0; ask(false); };
  socket.onmessage = event => {
    const told = take(event.data);
    if (told.id === asked) ask(false);
  };
  socket.onclose = async event => {
    socket = null;
    let why = event.reason;
    try {           // a refusal says why only to who asks without a socket
      if (!why) why = (await (await fetch(address("status", {}))).json()).error;
    } catch (error) { why = error.message; }
    if (why) say(why);
    setTimeout(follow, why ? 1000 : 100);
  };
}

// Ask for the next image, or for the newest again: a region or a picture is new.
function ask(again) {
  if (again) after = 0;
  asked += 1;
  if (socket && socket.readyState === WebSocket.OPEN)
    socket.send(JSON.stringify({after, panes: [...shown], region, id: asked}));
}

function take(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const told = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const size = told.width * told.height, planes = {};
  told.planes.forEach((name, i) => {
    planes[name] = new Uint8Array(buffer, 4 + length + i * size, size);
  });
  for (const name of shown) if (planes[name]) draw(name, told, planes);
  for (const name of shown) {
    const {title, facts} = figures[name], text = (told.missing || []).includes(name)
      ? `${facts.title}: ${told.status.method} gives none` : facts.title;
    if (title.textContent !== text) title.textContent = text;
  }
  after = told.number;
  if (told.planes.length) {
    drawn += 1;
    shownUs = told.t_us;
    document.body.dataset.drawn = drawn;
    document.body.dataset.t = told.t_us;
  }
  if (told.values) measure(told.values);
  tell(told.status);
  return told;
}

// A plane has a number for each pixel: its colour is looked up here.
function draw(name, {width, height}, planes) {
  const figure = figures[name], canvas = figure.canvas;
  if (canvas.width !== width || canvas.height !== height || !figure.image) {
    canvas.width = width;
    canvas.height = height;
    figure.context = canvas.getContext("2d", {alpha: false});
    figure.image = figure.context.createImageData(width, height);
    figure.words = new Uint32Array(figure.image.data.buffer);
  }
  const words = figure.words, pixels = planes[name], n = words.length;
  const table = colours[figure.facts.colours];
  if (figure.facts.colours === "hue") {
    const faded = table, dolp = planes.dolp;
    for (let i = 0; i < n; i++) words[i] = faded[dolp[i] << 8 | pixels[i]];
  } else {
    for (let i = 0; i < n; i++) words[i] = table[pixels[i]];
  }
  figure.context.putImageData(figure.image, 0, 0);
  if (name === "s0") { lastImage = {width, height, pixels}; seldom(histogram, 200); }
}

// Tables from a plane's number to a pixel of a canvas; of AoP, by DoLP's number too.
function makeColours({colours: lists, full_dolp: full}) {
  const word = ([r, g, b], part) => (0xff000000 | Math.round(b * part) << 16
    | Math.round(g * part) << 8 | Math.round(r * part)) >>> 0;
  colours = {};
  for (const [name, list] of Object.entries(lists))
    colours[name] = Uint32Array.from(list, colour => word(colour, 1));
  const faded = new Uint32Array(256 * 256);
  for (let d = 0; d < 256; d++)
    for (let a = 0; a < 256; a++)
      faded[d << 8 | a] = word(lists.hue[a], a === 255 ? 1 : Math.min(d / 254 / full, 1));
  colours.hue = faded;
}

// Numbers and curves change four to ten times a second, as fast as one can read; the
// last change is never left out.
const done = new Map(), waiting = new Set();
function seldom(does, ms) {
  if (waiting.has(does)) return;
  waiting.add(does);
  const now = performance.now(), due = (done.get(does) || 0) + ms;
  setTimeout(() => {
    waiting.delete(does);
    done.set(does, performance.now());
    does();
  }, Math.max(due - now, 0));
}

function put(id, text) {
  if ($(id).textContent !== text) $(id).textContent = text;
}

function histogram() {
  const {width, height, pixels} = lastImage, counts = new Float64Array(256);
  for (const value of pixels) counts[value]++;
  const canvas = $("histogram"), context = canvas.getContext("2d");
  const style = getComputedStyle(document.documentElement);
  const most = Math.max(...counts, 1);
  context.clearRect(0, 0, 256, 60);
  context.fillStyle = style.getPropertyValue("--s0");
  counts.forEach((n, i) => context.fillRect(i, 60 - 60 * n / most, 1, 60));
  const full = counts[255] / (width * height);
  if (full > 0) {
    context.fillStyle = style.getPropertyValue("--mark");
    context.fillRect(250, 0, 6, 60);
  }
  // Focus: mean square of the Laplacian over the region, the larger the sharper.
  const [x0, y0, w, h] = region && region[2] > 2 ? region : [0, 0, width, height];
  let sum = 0, n = 0;
  for (let y = Math.max(y0, 1); y < Math.min(y0 + h, height - 1); y++)
    for (let x = Math.max(x0, 1); x < Math.min(x0 + w, width - 1); x++) {
      const i = y * width + x;
      const d = 4 * pixels[i] - pixels[i - 1] - pixels[i + 1]
        - pixels[i - width] - pixels[i + width];
      sum += d * d;
      n++;
    }
  put("focus", `sharpness ${(sum / Math.max(n, 1)).toFixed(1)}   `
    + `full scale ${(100 * full).toFixed(1)} %`);
}

// ---- pictures and regions -----------------------------------------------------------

function makeFigures({quantities, colours: lists}) {
  for (const facts of quantities) {
    const name = facts.name, list = lists[facts.colours];
    const button = document.createElement("button");
    button.textContent = name;
    button.title = `show or hide ${facts.title} (${Object.keys(figures).length + 1})`;
    button.onclick = () => toggle(name);
    $("panes").append(button);
    const figure = document.createElement("figure");
    const caption = document.createElement("figcaption");
    const title = document.createElement("span");
    title.textContent = facts.title;
    const legend = document.createElement("span");
    const bar = document.createElement("canvas");
    bar.className = "legend"; bar.width = 144; bar.height = 12;
    legend.append(facts.ends[0] + " ", bar, " " + facts.ends[1]);
    const context = bar.getContext("2d");
    for (let x = 0; x < 144; x++) {
      context.fillStyle = `rgb(${list[Math.round(254 * x / 143)]})`;
      context.fillRect(x, 0, 1, 12);
    }
    caption.append(title, legend);
    const canvas = document.createElement("canvas");
    canvas.className = "picture";
    canvas.id = "pane-" + name;
    const mark = document.createElement("div");
    mark.className = "region"; mark.hidden = true;
    figure.append(caption, canvas, mark);
    figures[name] = {figure, canvas, button, mark, title, facts, image: null};
    title.ondblclick = () => { large = large === name ? null : name; arrange(); };
    canvas.onpointerdown = event => {
      canvas.setPointerCapture(event.pointerId);
      drag = place(canvas, event);
      region = [...drag, 1, 1]; trace = []; arrange();
    };
    canvas.onpointermove = event => {
      const [x, y] = place(canvas, event);
      if (!drag) { if (!event.buttons && !trace.length) { region = [x, y, 1, 1]; } return; }
      region = [Math.min(x, drag[0]), Math.min(y, drag[1]),
        Math.abs(x - drag[0]) + 1, Math.abs(y - drag[1]) + 1];
      arrange();
    };
    canvas.onpointerup = () => { drag = null; trace = []; ask(true); };
  }
  arrange();
}

function place(canvas, event) {
  const box = canvas.getBoundingClientRect();
  return [Math.floor((event.clientX - box.left) * canvas.width / box.width),
    Math.floor((event.clientY - box.top) * canvas.height / box.height)];
}

function toggle(name) {
  if (shown.has(name)) shown.delete(name); else shown.add(name);
  arrange();
  ask(true);
}

function arrange() {
  for (const [name, one] of Object.entries(figures)) {
    one.button.setAttribute("aria-pressed", shown.has(name));
    one.figure.className = large === name ? "large" : "";
    if (shown.has(name)) $("grid").append(one.figure); else one.figure.remove();
    one.mark.hidden = !region;
    if (region) {
      const {canvas, mark} = one, s = canvas.clientWidth / canvas.width;
      mark.style.left = region[0] * s + "px";
      mark.style.top = canvas.offsetTop + region[1] * s + "px";
      mark.style.width = region[2] * s + "px";
      mark.style.height = region[3] * s + "px";
    }
  }
}

// ---- numbers and traces --------------------------------------------------------------

function number(value, digits) {
  return value === undefined || value === null ? "\u2013" : value.toFixed(digits);
}

function measure(v) {
  lastValues = v;
  if (v.aop_deg !== undefined) {
    while (trace.length && v.t_us <= trace[trace.length - 1].t_us) trace.pop();
    trace.push(v);
    if (trace.length > MOST_POINTS) trace.splice(0, MOST_POINTS / 10);
    document.body.dataset.points = trace.length;
  }
  seldom(showValues, 100);
}

function showValues() {
  const v = lastValues;
  if (v.aop_deg === undefined) {
    put("angle", "\u2013");
    put("each", "");
    put("numbers", `(${v.x}, ${v.y})  nothing is known here`);
    return;
  }
  const pm = (sigma, digits) => sigma === undefined || sigma === null ? ""
    : " \u00b1 " + sigma.toFixed(digits);
  put("angle", `${v.aop_deg.toFixed(2)}\u00b0`
    + (v.aop_sigma_deg === undefined ? "" : pm(v.aop_sigma_deg, 2) + "\u00b0"));
  put("each", v.pixels > 1 && v.aop_sigma_deg !== undefined ? "(sigma of one pixel)" : "");
  // A name and its value stay on one line.
  const pairs = (...parts) => parts.map(part => part.replaceAll(" ", "\u00a0")).join("   ");
  put("numbers", pairs(`(${v.x}, ${v.y})`, `${v.pixels} pixel${v.pixels > 1 ? "s" : ""}`,
    `DoLP ${v.dolp.toFixed(4)}${pm(v.dolp_sigma, 4)}`, `S0 ${number(v.s0, 2)}`) + "\n"
    + pairs(...["I0", "I45", "I90", "I135"].map(
      (name, i) => `${name} ${number(v.quad[i], 2)}`)));
  plot();
}

function plot() {
  const canvas = $("plot"), context = canvas.getContext("2d");
  const w = canvas.width = canvas.clientWidth, h = canvas.height = canvas.clientHeight;
  const style = getComputedStyle(document.documentElement);
  const points = trace.slice(-Math.max(2 * w, 100));
  if (points.length < 2) return;
  const first = points[0].t_us, span = points[points.length - 1].t_us - first;
  const most = Math.max(...points.map(p => p.s0), 1e-9);
  $("most").textContent = most.toPrecision(3);
  const line = (name, value, wraps) => {
    context.strokeStyle = style.getPropertyValue("--" + name);
    context.beginPath();
    let before = null;
    for (const p of points) {
      const part = value(p), x = (p.t_us - first) / span * (w - 1);
      const y = (1 - part) * (h - 2) + 1;
      if (before === null || (wraps && Math.abs(part - before) > 0.5)) context.moveTo(x, y);
      else context.lineTo(x, y);
      before = part;
    }
    context.stroke();
  };
  line("s0", p => p.s0 / most, false);
  line("dolp", p => Math.min(p.dolp, 1), false);
  line("aop", p => p.aop_deg / 180, true);
  context.fillStyle = style.getPropertyValue("--ink");
  context.font = "12px system-ui, sans-serif";
  context.textAlign = "right";
  context.fillText(`${(span / 1e6).toPrecision(3)} s`, w - 4, h / 2);
}

function save(parts, kind, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob(parts, {type: kind}));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

function csv() {
  const names = ["t_us", "x", "y", "pixels", "aop_deg", "aop_sigma_deg", "dolp",
    "dolp_sigma", "s0"];
  save([names.join(",") + "\n", ...trace.map(p => names.map(
    name => p[name] === undefined || p[name] === null ? "" : p[name]).join(",") + "\n")],
  "text/csv", "trace.csv");
}

async function snapshot() {
  const answer = await fetch(address("snapshot.npz", {}));
  if (!answer.ok) { say((await answer.json()).error); return; }
  save([await answer.arrayBuffer()], "application/octet-stream", "snapshot.npz");
  for (const name of shown)
    figures[name].canvas.toBlob(blob => save([blob], "image/png", `snapshot_${name}.png`));
}

// ---- status and controls -------------------------------------------------------------

function tell(told) {
  status = told;
  const method = $("method");
  if (!method.options.length)
    for (const name of told.methods) method.add(new Option(name, name));
  change(method, "value", told.method);
  change($("fps"), "value", String(told.fps));
  change($("timeline"), "hidden", told.live);
  change($("record"), "hidden", !told.live);
  if (told.live) {
    const recording = String(told.stats.recording !== null);
    if ($("record").getAttribute("aria-pressed") !== recording)
      $("record").setAttribute("aria-pressed", recording);
  } else {
    put("play", told.playing ? "pause" : "play");
    change($("seek"), "max", String(Math.max(told.count - 1, 0)));
    if (told.playing) $("seek").value = told.index;
    else change($("seek"), "value", String(told.index));
    change($("speed"), "value", String(told.speed));
    put("time", shownUs === null ? "" : `${((shownUs - told.start_us) / 1e6).toFixed(3)} s`);
  }
  const error = told.live ? told.stats.error : told.error;
  if (error) say(error);
  seldom(showStatus, 250);
}

// What did not change is left alone: the browser would lay the page out again.
function change(element, name, value) {
  if (element[name] !== value && document.activeElement !== element)
    element[name] = value;
}

function showStatus() {
  const told = status, s = told.stats;
  put("stats", (told.live ? [
    `${s.state}   ${(s.events_per_s / 1e6).toFixed(3)} Mev/s   `
    + `${s.images_per_s.toFixed(1)} images/s   latency ${number(s.latency_ms, 1)} ms, `
    + `95 % ${number(s.latency_p95_ms, 1)} ms   queue ${s.queued_ms.toFixed(0)} ms`,
    `${s.method}   dropped ${s.dropped_events} events, ${s.jumps} jumps   skipped `
    + `${s.skipped_images} images` + (s.recording ? `   recording ${s.recording}: `
    + `${s.recorded_events} events` : ""),
  ] : [`image ${told.index + 1} of ${told.count}   ${told.method}`])
    .concat(told.problems).join("\n"));
}

function zoom() {
  if (!region || region[2] < 2 || region[3] < 2) { say("drag a region first"); return; }
  const [x, y] = status.roi || [0, 0];
  const chosen = [x + region[0], y + region[1], region[2], region[3]];
  region = null;
  command("roi", chosen).then(arrange);
}

// The button says what it does.
function named() {
  put("look", document.documentElement.classList.contains("dark") ? "light" : "dark");
}

function begin() {
  if (matchMedia("(prefers-color-scheme: dark)").matches)
    document.documentElement.classList.add("dark");
  named();
  for (const speed of [0.01, 0.03, 0.1, 0.25, 0.5, 1, 2, 4])
    $("speed").add(new Option(speed, speed));
  $("method").onchange = () => command("method", $("method").value);
  $("fps").onchange = () => command("fps", Number($("fps").value));
  $("speed").onchange = () => command("speed", Number($("speed").value));
  $("seek").oninput = () => command("seek", Number($("seek").value));
  const act = {play: () => command(status.playing ? "pause" : "play"),
    back: () => command("step", -1), on: () => command("step", 1),
    whole: () => command("roi", null), zoom, snapshot, csv,
    record: () => command("record", status.stats.recording === null),
    forget: () => { trace = []; plot(); }, look: () => {
      document.documentElement.classList.toggle("dark"); named(); plot();
      if (lastImage) histogram(); }};
  for (const [id, does] of Object.entries(act)) $(id).onclick = does;
  const keys = {" ": "play", ArrowLeft: "back", ArrowRight: "on", r: "record",
    s: "snapshot", l: "look", w: "whole", z: "zoom"};
  document.onkeydown = event => {
    if (event.ctrlKey || event.metaKey || /INPUT|SELECT/.test(event.target.tagName)) return;
    const pane = Object.keys(figures)[Number(event.key) - 1];
    if (pane) toggle(pane);
    else if (keys[event.key] && !$(keys[event.key]).closest("[hidden]")) {
      event.preventDefault();
      act[keys[event.key]]();
    }
  };
  addEventListener("resize", arrange);
  fetch(address("status", {palettes: 1})).then(answer => answer.json()).then(told => {
    if (told.error) { say(told.error); return; }
    makeColours(told.palettes);
    makeFigures(told.palettes);
    tell(told);
    follow();
  }).catch(error => say(error.message));
}

begin();
