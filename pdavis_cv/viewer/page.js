// The page: asks for the next image, draws it, and sends what buttons and keys say.
"use strict";
const $ = id => document.getElementById(id);
const token = new URLSearchParams(location.search).get("token");
const MOST_POINTS = 20000;
const NAMES = {s0: "S0", aop: "AoP, faded by DoLP", dolp: "DoLP",
  events: "events", uncertainty: "sigma of AoP"};
const ENDS = {s0: ["0", "full scale"], aop: ["0\u00b0", "180\u00b0"], dolp: ["0", "1"],
  events: ["OFF", "ON"], uncertainty: ["0\u00b0", "45\u00b0"]};
const shown = new Set(["s0", "aop", "dolp"]);
const figures = {};
let large = null, region = null, drag = null, status = {}, after = 0, drawn = 0;
let trace = [], lastImage = null, pending = null;

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

async function follow() {
  for (;;) {
    try {
      const values = {after: after, panes: [...shown].join(",")};
      if (region) values.region = region.join(",");
      pending = new AbortController();
      const answer = await fetch(address("frame", values), {signal: pending.signal});
      if (!answer.ok) throw new Error((await answer.json()).error);
      take(await answer.arrayBuffer());
    } catch (error) {
      if (error.name === "AbortError") continue;
      say(error.message);
      await new Promise(done => setTimeout(done, 1000));
    }
  }
}

function take(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const told = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let at = 4 + length;
  for (const one of told.panes) {
    const size = one.width * one.height * 3;
    draw(one, new Uint8Array(buffer, at, size));
    at += size;
  }
  after = told.number;
  if (told.panes.length) {
    drawn += 1;
    document.body.dataset.drawn = drawn;
    document.body.dataset.t = told.t_us;
  }
  if (told.values) measure(told.values);
  tell(told.status);
}

function draw(one, pixels) {
  const figure = figures[one.name];
  if (!figure) return;
  const canvas = figure.canvas;
  if (canvas.width !== one.width || canvas.height !== one.height) {
    canvas.width = one.width;
    canvas.height = one.height;
    figure.image = null;
  }
  const context = canvas.getContext("2d");
  if (!figure.image) {
    figure.image = context.createImageData(one.width, one.height);
    figure.words = new Uint32Array(figure.image.data.buffer);
  }
  const words = figure.words;
  for (let i = 0, j = 0; i < words.length; i++, j += 3)
    words[i] = 0xff000000 | pixels[j + 2] << 16 | pixels[j + 1] << 8 | pixels[j];
  context.putImageData(figure.image, 0, 0);
  if (one.name === "s0") { lastImage = {...one, pixels}; histogram(); }
}

function histogram() {
  const {width, height, pixels} = lastImage, counts = new Float64Array(256);
  for (let j = 0; j < pixels.length; j += 3) counts[pixels[j]]++;
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
      const i = 3 * (y * width + x);
      const d = 4 * pixels[i] - pixels[i - 3] - pixels[i + 3]
        - pixels[i - 3 * width] - pixels[i + 3 * width];
      sum += d * d;
      n++;
    }
  $("focus").textContent = `sharpness ${(sum / Math.max(n, 1)).toFixed(1)}   `
    + `full scale ${(100 * full).toFixed(1)} %`;
}

// ---- pictures and regions -----------------------------------------------------------

function makeFigures() {
  for (const name of Object.keys(NAMES)) {
    const button = document.createElement("button");
    button.textContent = name;
    button.title = `show or hide ${NAMES[name]} (${Object.keys(figures).length + 1})`;
    button.onclick = () => toggle(name);
    $("panes").append(button);
    const figure = document.createElement("figure");
    const caption = document.createElement("figcaption");
    const title = document.createElement("span");
    title.textContent = NAMES[name];
    const legend = document.createElement("span");
    const bar = document.createElement("canvas");
    bar.className = "legend"; bar.width = 144; bar.height = 12;
    legend.append(ENDS[name][0] + " ", bar, " " + ENDS[name][1]);
    caption.append(title, legend);
    const canvas = document.createElement("canvas");
    canvas.className = "picture";
    canvas.id = "pane-" + name;
    const mark = document.createElement("div");
    mark.className = "region"; mark.hidden = true;
    figure.append(caption, canvas, mark);
    figures[name] = {figure, canvas, button, bar, mark, image: null};
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
    canvas.onpointerup = () => { drag = null; trace = []; ask(); };
  }
  arrange();
  legends();
}

// Ask for the newest image again: a region or a picture is new.
function ask() {
  after = 0;
  if (pending) pending.abort();
}

function place(canvas, event) {
  const box = canvas.getBoundingClientRect();
  return [Math.floor((event.clientX - box.left) * canvas.width / box.width),
    Math.floor((event.clientY - box.top) * canvas.height / box.height)];
}

function toggle(name) {
  if (shown.has(name)) shown.delete(name); else shown.add(name);
  arrange();
  ask();
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

function legends() {
  const fill = (name, colour) => {
    const context = figures[name].bar.getContext("2d");
    for (let x = 0; x < 144; x++) {
      context.fillStyle = colour(x / 143);
      context.fillRect(x, 0, 1, 12);
    }
  };
  const grey = part => `rgb(${[0, 0, 0].map(() => Math.round(255 * part))})`;
  fill("s0", grey);
  fill("events", grey);
  fill("aop", part => `hsl(${360 * part} 100% 50%)`);
  for (const name of ["dolp", "uncertainty"])
    fill(name, part => `rgb(${status.ramp ? status.ramp[Math.round(255 * part)] : [0, 0, 0]})`);
}

// ---- numbers and traces --------------------------------------------------------------

function number(value, digits) {
  return value === undefined || value === null ? "\u2013" : value.toFixed(digits);
}

function measure(v) {
  if (v.aop_deg === undefined) { $("angle").textContent = "\u2013"; return; }
  const pm = (sigma, digits) => sigma === undefined || sigma === null ? ""
    : " \u00b1 " + sigma.toFixed(digits);
  $("angle").textContent = `${v.aop_deg.toFixed(2)}\u00b0`
    + (v.aop_sigma_deg === undefined ? "" : pm(v.aop_sigma_deg, 2) + "\u00b0");
  $("numbers").textContent = `(${v.x}, ${v.y})  ${v.pixels} pixel${v.pixels > 1 ? "s" : ""}`
    + `   DoLP ${v.dolp.toFixed(4)}${pm(v.dolp_sigma, 4)}   S0 ${number(v.s0, 2)}\n`
    + `I0 ${number(v.quad[0], 2)}   I45 ${number(v.quad[1], 2)}   `
    + `I90 ${number(v.quad[2], 2)}   I135 ${number(v.quad[3], 2)}`;
  while (trace.length && v.t_us <= trace[trace.length - 1].t_us) trace.pop();
  trace.push(v);
  if (trace.length > MOST_POINTS) trace.splice(0, MOST_POINTS / 10);
  document.body.dataset.points = trace.length;
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
  context.fillText(`${(span / 1e6).toPrecision(3)} s`, w - 50, h - 4);
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
  const before = status;
  status = told;
  if (told.ramp && !before.ramp) legends();
  if (!told.ramp) status.ramp = before.ramp;
  const method = $("method");
  if (!method.options.length)
    for (const name of told.methods) method.add(new Option(name, name));
  if (document.activeElement !== method) method.value = told.method;
  if (document.activeElement !== $("fps")) $("fps").value = told.fps;
  $("timeline").hidden = told.live;
  $("record").hidden = !told.live;
  if (told.live) {
    const s = told.stats;
    $("record").setAttribute("aria-pressed", s.recording !== null);
    $("stats").textContent = [
      `${s.state}   ${(s.events_per_s / 1e6).toFixed(3)} Mev/s   `
      + `${s.images_per_s.toFixed(1)} images/s   latency ${number(s.latency_ms, 1)} ms, `
      + `95 % ${number(s.latency_p95_ms, 1)} ms   queue ${s.queued_ms.toFixed(0)} ms`,
      `${s.method}   dropped ${s.dropped_events} events, ${s.jumps} jumps   skipped `
      + `${s.skipped_images} images` + (s.recording ? `   recording ${s.recording}: `
      + `${s.recorded_events} events` : ""),
      ...told.problems].join("\n");
    if (s.error) say(s.error);
  } else {
    $("play").textContent = told.playing ? "pause" : "play";
    $("seek").max = Math.max(told.count - 1, 0);
    if (document.activeElement !== $("seek") || told.playing) $("seek").value = told.index;
    $("speed").value = told.speed;
    $("stats").textContent = [`image ${told.index + 1} of ${told.count}   ${told.method}`,
      ...told.problems].join("\n");
    if (told.error) say(told.error);
  }
}

function zoom() {
  if (!region || region[2] < 2 || region[3] < 2) { say("drag a region first"); return; }
  const [x, y] = status.roi || [0, 0];
  const chosen = [x + region[0], y + region[1], region[2], region[3]];
  region = null;
  command("roi", chosen).then(arrange);
}

function begin() {
  if (matchMedia("(prefers-color-scheme: dark)").matches)
    document.documentElement.classList.add("dark");
  makeFigures();
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
    forget: () => { trace = []; }, look: () => {
      document.documentElement.classList.toggle("dark"); plot(); }};
  for (const [id, does] of Object.entries(act)) $(id).onclick = does;
  const keys = {" ": "play", ArrowLeft: "back", ArrowRight: "on", r: "record",
    s: "snapshot", l: "look", w: "whole", z: "zoom"};
  document.onkeydown = event => {
    if (event.ctrlKey || event.metaKey || /INPUT|SELECT/.test(event.target.tagName)) return;
    const pane = Object.keys(NAMES)[Number(event.key) - 1];
    if (pane) toggle(pane);
    else if (keys[event.key] && !$(keys[event.key]).closest("[hidden]")) {
      event.preventDefault();
      act[keys[event.key]]();
    }
  };
  addEventListener("resize", arrange);
  fetch(address("status", {ramp: 1})).then(answer => answer.json()).then(told => {
    if (told.error) say(told.error); else { tell(told); follow(); }
  }, error => say(error.message));
}

begin();
