// Pictures: colours, layout, zoom and pan.  All positions that are kept are in pixels of
// the whole sensor; `view` is the part of the image that is seen.
"use strict";
const $ = id => document.getElementById(id);
const SHARPEST = 64;        // most image pixels of the sensor's width per window's
const shown = new Set(["s0", "aop", "dolp"]);
const figures = {};
const view = {zoom: 1, x: 0, y: 0};     // left and top in parts of the image
let colours = null, lists = null, hatch = null, size = [4, 3], origin = [0, 0], step = 1,
  levels = null, newest = null, drag = null;

function made(kind, inside, words = {}) {
  const element = Object.assign(document.createElement(kind), words);
  inside.append(element);
  return element;
}

// Tables from a plane's number to a pixel of a canvas; of AoP, by DoLP's number too.
function makeColours({colours: given, stripes, full_dolp: full}) {
  const word = ([r, g, b], part) => (0xff000000 | Math.round(b * part) << 16
    | Math.round(g * part) << 8 | Math.round(r * part)) >>> 0;
  colours = {};
  lists = given;
  for (const [name, list] of Object.entries(lists))
    colours[name] = Uint32Array.from(list, colour => word(colour, 1));
  const faded = new Uint32Array(256 * 256);
  for (let d = 0; d < 256; d++)
    for (let a = 0; a < 256; a++)
      faded[d << 8 | a] = word(lists.hue[a], a === 255 ? 1 : Math.min(d / 254 / full, 1));
  colours.hue = faded;
  // What is not valid is transparent, and the window behind is hatched, finely at any zoom.
  for (const name of ["hue", "viridis", "grey"])
    for (let i = 255; i < colours[name].length; i += 256) colours[name][i] = 0;
  hatch = document.createElement("canvas");
  hatch.width = hatch.height = 8;
  const context = hatch.getContext("2d");
  for (let i = 0; i < 64; i++) {
    context.fillStyle = `rgb(${stripes[(i >> 3) + i % 8 >> 2 & 1]})`;
    context.fillRect(i % 8, i >> 3, 1, 1);
  }
  document.body.style.setProperty("--hatch", `url(${hatch.toDataURL()})`);
}

function makeFigures(quantities) {
  for (const facts of quantities) {
    const name = facts.name, figure = document.createElement("figure");
    const button = made("button", $("panes"), {textContent: facts.symbol,
      title: `${facts.title} (${Object.keys(figures).length + 1})`});
    button.onclick = () => toggle(name);
    const caption = made("figcaption", figure);
    const title = made("span", caption, {className: "title"});
    made("b", title, {textContent: facts.symbol});
    const long = made("span", title, {className: "long"});
    const scale = made("span", caption, {className: "scale"});
    const low = name === "s0" ? field(scale, 0) : made("span", scale, {textContent: facts.ends[0]});
    bar(made("canvas", scale, {width: 144, height: 12}).getContext("2d"), facts, 0, 0, 144, 12);
    const high = name === "s0" ? field(scale, 1) : made("span", scale, {textContent: facts.ends[1]});
    if (name === "s0") {
      made("small", scale, {textContent: facts.unit});
      made("button", scale, {id: "auto", textContent: "auto", onclick: auto,
        title: "fit contrast to this image (a)"});
    }
    const frame = made("div", figure, {className: "window"});
    const stage = made("div", frame, {className: "stage"});
    const canvas = made("canvas", stage, {className: "picture", id: "pane-" + name});
    figures[name] = {facts, figure, button, long, low, high, frame, stage, canvas, image: null};
    listen(figures[name]);
  }
  arrange();
}

function bar(context, facts, x0, y0, width, height) {
  for (let x = 0; x < width; x++) {
    const last = facts.colours === "tone" ? 255 : 253;
    context.fillStyle = `rgb(${lists[facts.colours][Math.round(last * x / (width - 1))]})`;
    context.fillRect(x0 + x, y0, 1, height);
  }
}

function field(inside, which) {
  const input = made("input", inside, {type: "number", step: "any", id: which ? "white" : "black",
    title: which ? "S0 shown white" : "S0 shown black"});
  input.onchange = () => {
    const wanted = [Number($("black").value), Number($("white").value)];
    if (!(wanted[0] < wanted[1])) { say("black must be below white"); return; }
    levels = wanted;
    input.blur();
    ask(true);
  };
  return input;
}

function auto() { levels = null; ask(true); }

// A plane has a number for each pixel: its colour is looked up here.
function draw(name, {width, height}, planes) {
  const one = figures[name], canvas = one.canvas;
  if (canvas.width !== width || canvas.height !== height || !one.image) {
    canvas.width = width;
    canvas.height = height;
    one.context = canvas.getContext("2d");
    one.image = one.context.createImageData(width, height);
    one.words = new Uint32Array(one.image.data.buffer);
  }
  const words = one.words, pixels = planes[name], table = colours[one.facts.colours];
  if (one.facts.colours === "hue") {
    const dolp = planes.dolp;
    for (let i = 0; i < words.length; i++) words[i] = table[dolp[i] << 8 | pixels[i]];
  } else {
    for (let i = 0; i < words.length; i++) words[i] = table[pixels[i]];
  }
  one.context.putImageData(one.image, 0, 0);
}

function drawAll(told, planes) {
  levels = told.levels;
  for (const [id, value] of [["black", levels[0]], ["white", levels[1]]])
    if ($(id)) change($(id), "value", String(Number(value.toPrecision(4))));
  for (const name of shown) {
    if (planes[name]) draw(name, told, planes);
    const {long, facts} = figures[name];
    change(long, "textContent", told.missing.includes(name)
      ? ` ${told.status.method} gives none` : ` ${facts.title}`);
  }
  newest = {told, planes};
  const [x, y] = told.status.roi, now = told.status.step;
  if (size[0] !== told.width || size[1] !== told.height || origin[0] !== x
      || origin[1] !== y || step !== now) {
    size = [told.width, told.height];
    origin = [x, y];
    step = now;
    arrange();
  }
  seldom(spread, 200);
}

// ---- layout, zoom and pan -----------------------------------------------------------

// As many columns as make the pictures largest in what the window leaves them.
function arrange() {
  const grid = $("grid"), n = Math.max(shown.size, 1), aspect = size[0] / size[1], gap = 8;
  const room = grid.clientWidth - 26;
  const high = innerHeight - document.querySelector("header").offsetHeight
    - document.querySelector("footer").offsetHeight - (innerHeight > 700 ? 290 : 40);
  let best = room;
  if (innerWidth > 640) {
    best = 0;
    for (let c = 1; c <= n; c++) {
      const rows = Math.ceil(n / c);
      const size = Math.min((room - gap * (c - 1)) / c,
        ((high - gap * (rows - 1)) / rows - 31) * aspect);
      if (size > 0.98 * best) best = size;    // of two as large, that with fewer rows
    }
    best = Math.max(best, Math.min(room, 250));
  }
  grid.style.gridTemplateColumns = `repeat(auto-fit, ${Math.floor(best)}px)`;
  for (const [name, one] of Object.entries(figures)) {
    one.button.setAttribute("aria-pressed", shown.has(name));
    one.frame.style.aspectRatio = `${size[0]} / ${size[1]}`;
    if (shown.has(name)) grid.append(one.figure); else one.figure.remove();
  }
  look();
}

function look() {
  view.x = Math.min(Math.max(view.x, 0), 1 - 1 / view.zoom);
  view.y = Math.min(Math.max(view.y, 0), 1 - 1 / view.zoom);
  for (const {stage} of Object.values(figures)) {
    stage.style.width = stage.style.height = 100 * view.zoom + "%";
    stage.style.left = -100 * view.zoom * view.x + "%";
    stage.style.top = -100 * view.zoom * view.y + "%";
  }
  document.body.dataset.zoom = view.zoom;
  marks();
}

function zoomBy(factor, partX, partY) {
  const zoom = Math.min(Math.max(view.zoom * factor, 1), SHARPEST);
  view.x += partX / view.zoom - partX / zoom;
  view.y += partY / view.zoom - partY / zoom;
  view.zoom = zoom;
  look();
}

function zoomTo([x, y, w, h]) {
  const part = [(x - origin[0]) / step / size[0], (y - origin[1]) / step / size[1],
    w / step / size[0], h / step / size[1]];
  view.zoom = Math.min(Math.max(0.8 / Math.max(part[2], part[3]), 1), SHARPEST);
  view.x = part[0] + part[2] / 2 - 0.5 / view.zoom;
  view.y = part[1] + part[3] / 2 - 0.5 / view.zoom;
  look();
}

function whole() { Object.assign(view, {zoom: 1, x: 0, y: 0}); look(); }

function toggle(name) {
  if (shown.has(name)) shown.delete(name); else shown.add(name);
  arrange();
  ask(true);
}

// The sensor's pixel under the pointer, inside the image.
function place(canvas, event) {
  const box = canvas.getBoundingClientRect();
  const at = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  return at.map((part, i) => origin[i] + step * Math.min(
    Math.max(Math.floor(part * size[i]), 0), size[i] - 1));
}

function between([x0, y0], [x1, y1]) {
  return [Math.min(x0, x1), Math.min(y0, y1), Math.abs(x1 - x0) + step, Math.abs(y1 - y0) + step];
}

function listen({frame, canvas}) {
  frame.onpointerdown = event => {
    if (event.button > 1) return;
    event.preventDefault();
    frame.setPointerCapture(event.pointerId);
    drag = {from: place(canvas, event), x: event.clientX, y: event.clientY,
      pans: event.shiftKey || event.button === 1};
  };
  frame.onpointermove = event => {
    if (drag && drag.pans) {
      const box = canvas.getBoundingClientRect();
      view.x -= (event.clientX - drag.x) / box.width;
      view.y -= (event.clientY - drag.y) / box.height;
      drag.x = event.clientX;
      drag.y = event.clientY;
      look();
    } else if (drag) {
      drag.box = between(drag.from, place(canvas, event));
      marks();
    } else {
      point([...place(canvas, event), step, step]);
    }
  };
  frame.onpointerup = event => {
    const ended = drag;
    drag = null;
    if (ended && !ended.pans) addRegion(between(ended.from, place(canvas, event)));
  };
  frame.onpointercancel = () => { drag = null; marks(); };
  frame.onpointerleave = () => { if (!drag) point(null); };
  frame.addEventListener("wheel", event => {
    event.preventDefault();
    const box = frame.getBoundingClientRect();
    zoomBy(1.0015 ** -event.deltaY, (event.clientX - box.left) / box.width,
      (event.clientY - box.top) / box.height);
  }, {passive: false});
}

// The outlines of all regions on all pictures.
function marks() {
  const boxes = regions.map(one => [one.box, one.colour, one.name]);
  if (drag && drag.box) boxes.push([drag.box, "#fff", drag.box.slice(2).join(" \u00d7 ")]);
  for (const {stage} of Object.values(figures)) {
    for (const old of stage.querySelectorAll(".region")) old.remove();
    for (const [box, colour, name] of boxes) {
      const mark = made("div", stage, {className: "region"});
      const at = [0, 1].map(i => (box[i] - origin[i]) / step / size[i]);
      mark.classList.toggle("inside", (at[1] - view.y) * view.zoom < 0.06);
      mark.style.setProperty("--colour", colour);
      mark.style.left = 100 * at[0] + "%";
      mark.style.top = 100 * at[1] + "%";
      mark.style.width = 100 * box[2] / step / size[0] + "%";
      mark.style.height = 100 * box[3] / step / size[1] + "%";
      made("span", mark, {textContent: name});
    }
  }
}

// ---- how values are spread -----------------------------------------------------------

// A canvas at the screen's resolution: its context, and its size in CSS pixels.
function sheet(id) {
  const canvas = $(id), ratio = devicePixelRatio || 1;
  const width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const context = canvas.getContext("2d");
  context.scale(ratio, ratio);
  context.font = "11px system-ui, sans-serif";
  return {context, width, height};
}

function ink(name) { return getComputedStyle(document.documentElement).getPropertyValue(name); }

// Of the last region, or else of the whole image.
function spread() {
  const {told, planes} = newest, {width, height} = told, last = regions.at(-1);
  const box = last ? [0, 1, 2, 3].map(i => Math.round(
    (last.box[i] - (i < 2 ? origin[i] : 0)) / step)) : [0, 0, width, height];
  const x0 = Math.max(box[0], 0), x1 = Math.min(box[0] + box[2], width);
  const y0 = Math.max(box[1], 0), y1 = Math.min(box[1] + box[3], height);
  rose(planes, width, x0, x1, y0, y1, last ? last.name : "whole image");
  if (!planes.s0) return;
  const pixels = planes.s0, counts = new Float64Array(255);
  let sum = 0, n = 0;
  for (let y = y0; y < y1; y++)
    for (let x = x0; x < x1; x++) {
      const i = y * width + x;
      if (pixels[i] < 255) counts[pixels[i]]++;
      if (x <= x0 || y <= y0 || x >= x1 - 1 || y >= y1 - 1) continue;
      const d = 4 * pixels[i] - pixels[i - 1] - pixels[i + 1]
        - pixels[i - width] - pixels[i + width];
      sum += d * d;
      n++;
    }
  const {context, width: w, height: h} = sheet("histogram");
  const most = Math.max(...counts.subarray(1, 254), 1);
  context.fillStyle = ink("--dim");
  counts.forEach((count, i) => {
    const tall = (h - 14) * Math.min(count / most, 1);
    context.fillRect(i * w / 255, h - 14 - tall, w / 255 + 0.3, tall);
  });
  context.textBaseline = "bottom";
  context.fillText("S0 from black to white", 0, h);
  // Sharpness: mean square of the Laplacian, the larger the sharper.
  put("focus", `sharpness ${(sum / Math.max(n, 1)).toFixed(1)}, `
    + `${(100 * told.saturated).toFixed(1)} % at full scale`);
}

// Polar histogram of AoP, axial (drawn on both sides), weighted by DoLP.
function rose(planes, width, x0, x1, y0, y1, title) {
  if (!planes.aop) return;
  const BINS = 36, sums = new Float64Array(BINS);
  for (let y = y0; y < y1; y++)
    for (let x = x0; x < x1; x++) {
      const a = planes.aop[y * width + x], d = planes.dolp[y * width + x];
      if (a < 254 && d < 255) sums[Math.floor(a * BINS / 254)] += d;
    }
  const {context, width: w, height: h} = sheet("rose");
  const r = Math.min(w, h - 32) / 2 - 12, cx = w / 2, cy = h / 2 + 6;
  const most = Math.max(...sums, 1e-9);
  context.strokeStyle = ink("--line");
  context.fillStyle = ink("--dim");
  context.textAlign = "center";
  context.textBaseline = "middle";
  for (const part of [0.5, 1]) {
    context.beginPath();
    context.arc(cx, cy, r * part, 0, 2 * Math.PI);
    context.stroke();
  }
  for (const degrees of [0, 45, 90, 135]) {
    const turn = -degrees * Math.PI / 180;
    context.fillText(`${degrees}\u00b0`, cx + (r + 13) * Math.cos(turn), cy + (r + 9) * Math.sin(turn));
  }
  context.fillText(`AoP by DoLP, ${title}`, cx, 7);
  for (let k = 0; k < 2 * BINS; k++) {
    context.fillStyle = `rgb(${lists.hue[Math.floor((k % BINS + 0.5) * 254 / BINS)]})`;
    context.beginPath();
    context.moveTo(cx, cy);
    context.arc(cx, cy, r * Math.sqrt(sums[k % BINS] / most),
      -k * Math.PI / BINS, -(k + 1) * Math.PI / BINS, true);
    context.fill();
  }
}

// ---- snapshot -------------------------------------------------------------------------

// All pictures that are shown, with titles, scales, regions and the time.
function snapshotPicture(footer) {
  const names = [...shown], scale = Math.max(1, Math.round(480 / size[0]));
  const w = size[0] * scale, h = size[1] * scale, gap = 16, head = 44;
  const canvas = document.createElement("canvas");
  canvas.width = names.length * (w + gap) + gap;
  canvas.height = h + head + 40;
  const context = canvas.getContext("2d");
  context.fillStyle = "#fff";
  context.fillRect(0, 0, canvas.width, canvas.height);
  context.imageSmoothingEnabled = false;
  context.textBaseline = "middle";
  names.forEach((name, k) => {
    const {facts, canvas: picture, low, high} = figures[name], x0 = gap + k * (w + gap);
    context.fillStyle = context.createPattern(hatch, "repeat");
    context.fillRect(x0, head, w, h);
    context.drawImage(picture, view.x * size[0], view.y * size[1], size[0] / view.zoom,
      size[1] / view.zoom, x0, head, w, h);
    context.fillStyle = "#000";
    context.font = "bold 16px system-ui, sans-serif";
    context.textAlign = "left";
    context.fillText(facts.symbol, x0, head / 2);
    context.font = "14px system-ui, sans-serif";
    const unit = name === "s0" ? " " + facts.unit : "";
    const ends = [low, high].map(one => one.value || one.textContent);
    const right = Math.floor(x0 + w - context.measureText(ends[1] + unit).width - 6);
    context.fillText(ends[1] + unit, right + 6, head / 2);
    bar(context, facts, right - 120, head / 2 - 6, 120, 12);
    context.fillStyle = "#000";
    context.textAlign = "right";
    context.fillText(ends[0], right - 126, head / 2);
    context.textAlign = "left";
    context.save();
    context.beginPath();
    context.rect(x0, head, w, h);
    context.clip();
    context.lineWidth = 2;
    context.shadowColor = "#000";
    context.shadowBlur = 4;         // seen on any colour
    for (const {box, colour, name: title} of regions) {
      const at = [0, 1].map(i => ((box[i] - origin[i]) / step / size[i]
        - (i ? view.y : view.x)) * view.zoom);
      const left = x0 + at[0] * w, top = head + at[1] * h;
      context.strokeStyle = context.fillStyle = colour;
      context.strokeRect(left, top, box[2] / step * scale * view.zoom,
        box[3] / step * scale * view.zoom);
      context.fillText(title, left + 3, Math.max(top - 9, head + 9));
    }
    context.restore();
  });
  context.fillStyle = "#000";
  context.fillText(footer, gap, canvas.height - 20);
  const right = canvas.width - gap - context.measureText("not valid").width;
  context.fillText("not valid", right, canvas.height - 20);
  context.fillStyle = context.createPattern(hatch, "repeat");
  context.fillRect(right - 22, canvas.height - 28, 16, 16);
  return canvas;
}
