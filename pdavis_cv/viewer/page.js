// The page: asks for the next image, and sends what buttons and keys say.
"use strict";
const token = new URLSearchParams(location.search).get("token");
let status = {}, after = 0, drawn = 0, socket = null, asked = 0, shownUs = null;

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

function say(text) { put("said", text); }

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
    socket.send(JSON.stringify({after, panes: [...shown], regions: asksFor(), levels, id: asked}));
}

function take(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const told = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  // What was asked for since has other pictures, regions or contrast.
  if (told.id === asked && told.values) {
    const pixels = told.width * told.height, planes = {};
    told.planes.forEach((name, i) => {
      planes[name] = new Uint8Array(buffer, 4 + length + i * pixels, pixels);
    });
    after = told.number;
    drawn += 1;
    shownUs = told.t_us;
    status = told.status;
    drawAll(told, planes);
    measure(told);
    document.body.dataset.drawn = drawn;
    document.body.dataset.t = told.t_us;
  }
  tell(told.status);
  return told;
}

// Numbers and curves change four to ten times a second, as fast as one can read; the
// last change is never left out.
const done = new Map(), waiting = new Set();
function seldom(does, ms, key = does) {
  if (waiting.has(key)) return;
  waiting.add(key);
  const now = performance.now(), due = (done.get(key) || 0) + ms;
  setTimeout(() => {
    waiting.delete(key);
    done.set(key, performance.now());
    does();
  }, Math.max(due - now, 0));
}

// What did not change is left alone: the browser would lay the page out again.
function put(id, text) { change($(id), "textContent", text); }

function change(element, name, value) {
  if (element[name] !== value && document.activeElement !== element)
    element[name] = value;
}

// ---- status and controls -------------------------------------------------------------

function number(value, digits) {
  return value === undefined || value === null ? "\u2013" : value.toFixed(digits);
}

function clock(t_us) { return `${((t_us - (status.start_us || 0)) / 1e6).toFixed(3)} s`; }

function tell(told) {
  status = told;
  const method = $("method");
  if (!method.options.length)
    for (const name of told.methods) method.add(new Option(name, name));
  put("name", told.name);
  change(document, "title", `${told.name} \u2013 pdavis_cv`);
  change(method, "value", told.method);
  change($("fps"), "value", String(told.fps));
  change($("timeline"), "hidden", told.live);
  change($("record"), "hidden", !told.live);
  if (told.live) {
    const recording = String(told.stats.recording !== null);
    if ($("record").getAttribute("aria-pressed") !== recording)
      $("record").setAttribute("aria-pressed", recording);
  } else {
    change($("play"), "textContent", told.playing ? "pause" : "play");
    change($("seek"), "max", String(Math.max(told.count - 1, 0)));
    if (told.playing) $("seek").value = told.index;
    else change($("seek"), "value", String(told.index));
    change($("speed"), "value", String(told.speed));
    put("time", shownUs === null ? "" : clock(shownUs));
  }
  const error = told.live ? told.stats.error : told.error;
  if (error) say(error);
  seldom(showStatus, 250);
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
  ] : [`image ${told.index + 1} of ${told.count}, ${told.method}`])
    .concat(told.problems).join("\n"));
}

async function snapshot() {
  const answer = await fetch(address("snapshot.npz", {}));
  if (!answer.ok) { say((await answer.json()).error); return; }
  save([await answer.arrayBuffer()], "application/octet-stream", stem() + ".npz");
  const told = newest.told;
  snapshotPicture(`${told.status.name}   ${clock(told.t_us)}   ${told.status.method}`).toBlob(
    blob => save([blob], "image/png", stem() + ".png"));
}

function begin() {
  for (const speed of [0.01, 0.03, 0.1, 0.25, 0.5, 1, 2, 4])
    $("speed").add(new Option(`${speed} \u00d7`, speed));
  $("method").onchange = () => command("method", $("method").value);
  $("fps").onchange = () => command("fps", Number($("fps").value));
  $("speed").onchange = () => command("speed", Number($("speed").value));
  $("seek").oninput = () => command("seek", Number($("seek").value));
  const act = {play: () => command(status.playing ? "pause" : "play"),
    back: () => command("step", -1), on: () => command("step", 1), auto, whole, snapshot, csv,
    geojson, record: () => command("record", status.stats.recording === null),
    zoom: () => regions.length ? zoomTo(regions.at(-1).box) : say("drag a region first"),
    restart: () => { rates.length = 0; for (const one of regions) one.trace = []; ask(true); },
    help: () => $("keys").showModal()};
  const keys = {" ": ["play", "play or pause"], ArrowLeft: ["back", "one image back"],
    ArrowRight: ["on", "one image on"], z: ["zoom", "zoom to the last region"],
    w: ["whole", "whole image"], a: ["auto", "fit contrast of S0 to this image"],
    s: ["snapshot", "save this image"], r: ["record", "record what arrives (live)"],
    "?": ["help", "this list"]};
  const shows = {" ": "space", ArrowLeft: "\u2190", ArrowRight: "\u2192"};
  for (const [key, text] of [["1 \u2026 5", "show or hide a picture"],
    ...Object.entries(keys).map(([key, [, text]]) => [shows[key] || key, text])]) {
    const row = made("tr", document.querySelector("#keys table"));
    made("kbd", made("td", row), {textContent: key});
    made("td", row, {textContent: text});
  }
  $("keys").onclick = () => $("keys").close();
  for (const [id, does] of Object.entries(act)) if ($(id)) $(id).onclick = does;
  document.onkeydown = event => {
    if (event.ctrlKey || event.metaKey || $("keys").open
        || (/INPUT|SELECT/.test(event.target.tagName) && event.target.type !== "range")) return;
    const pane = Object.keys(figures)[Number(event.key) - 1];
    if (pane) toggle(pane);
    else if (keys[event.key] && !(keys[event.key][0] === "record" && $("record").hidden)) {
      event.preventDefault();
      act[keys[event.key][0]]();
    }
  };
  const again = () => { arrange(); if (newest) spread(); showValues(); };
  addEventListener("resize", again);
  matchMedia("(prefers-color-scheme: dark)").onchange = again;
  fetch(address("status", {palettes: 1})).then(answer => answer.json()).then(told => {
    if (told.error) { say(told.error); return; }
    makeColours(told.palettes);
    makeFigures(told.palettes.quantities);
    status = told;
    listRegions();
    tell(told);
    arrange();
    follow();
  }).catch(error => say(error.message));
}

begin();
