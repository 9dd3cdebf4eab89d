// Regions: named rectangles of sensor pixels, their values, traces and exports.
"use strict";
const MOST_POINTS = 20000;
const TINTS = ["#e69f00", "#56b4e9", "#009e73", "#d55e00", "#cc79a7", "#0072b2", "#f0e442",
  "#b8b8b8"];
const regions = [], rates = [];    // and how many events there were
let pointed = null, pointedValues = null;

// A region's pixels never change, so that its trace is of one thing.
function addRegion(box) {
  const colour = TINTS.find(tint => !regions.some(one => one.colour === tint));
  if (!colour) { say(`at most ${TINTS.length} regions: remove one first`); return; }
  let letter = 0;
  while (regions.some(one => one.name === String.fromCharCode(65 + letter))) letter++;
  regions.push({box, colour, name: String.fromCharCode(65 + letter), trace: [], values: null});
  listRegions();
  ask(true);
}

function removeRegion(one) {
  regions.splice(regions.indexOf(one), 1);
  listRegions();
  ask(true);
}

function point(box) {
  if (String(box) === String(pointed)) return;
  pointed = box;
  pointedValues = null;
  seldom(() => ask(true), 100, "point");
}

// Time goes on in a trace: what was later is drawn anew.
function append(trace, point) {
  while (trace.length && point.t_us <= trace.at(-1).t_us) trace.pop();
  trace.push(point);
  if (trace.length > MOST_POINTS) trace.splice(0, MOST_POINTS / 10);
}

// What is asked for of each image; `measure` gets the values in the same order.
function asksFor() { return [...regions.map(one => one.box), ...(pointed ? [pointed] : [])]; }

function measure({values: found, t_us, events_per_s, status: {method}}) {
  append(rates, {t_us, rate: events_per_s / 1e6});
  regions.forEach((one, i) => {
    const v = one.values = found[i];
    if (v.aop_deg !== undefined) append(one.trace, {...v, method});
  });
  pointedValues = pointed ? found[regions.length] : null;
  document.body.dataset.points = Math.max(0, ...regions.map(one => one.trace.length));
  seldom(showValues, 100);
}

// ---- the list -----------------------------------------------------------------------

function listRegions() {
  $("regions").replaceChildren();
  for (const one of regions) {
    const row = one.row = made("tr", $("regions"));
    row.style.setProperty("--colour", one.colour);
    const cell = made("td", row);
    made("i", cell, {className: "chip"});
    const name = made("input", cell, {value: one.name, title: one.box.join(", "),
      ariaLabel: "name"});
    name.onchange = () => {
      one.name = name.value = name.value.trim() || one.name;
      marks();
      showValues();
    };
    one.cells = cells(row);
    made("button", made("td", row), {textContent: "\u00d7", title: "remove",
      onclick: () => removeRegion(one)});
  }
  const row = made("tr", $("regions"), {id: "pointer"});
  made("td", row, {id: "where"});
  row.cells_ = cells(row);
  made("td", row);
  $("exports").hidden = !regions.length;
  marks();
  showValues();
}

function cells(row) {
  return ["", "angle", "", ""].map(className => made("td", row, {className}));
}

function pm(value, error, unit, least) {
  if (value === undefined || value === null) return ["\u2013", ""];
  if (error === undefined || error === null) return [value.toPrecision(4) + unit, ""];
  const digits = Math.min(Math.max(1 - Math.floor(Math.log10(Math.max(error, 1e-9))), 0), least);
  return [value.toFixed(digits) + (error ? "" : unit), ` \u00b1 ${error.toFixed(digits)}${unit}`];
}

function fill(row, v) {
  const texts = !v ? [["", ""], ["", ""], ["", ""], ["", ""]] : [[String(v.pixels), ""],
    pm(v.aop_deg, v.aop_se_deg, "\u00b0", 3), pm(v.dolp, v.dolp_se, "", 5),
    pm(v.s0, v.s0_se, "", 3)];
  row.forEach((cell, i) => {
    if (cell.textContent === texts[i].join("")) return;
    cell.textContent = texts[i][0];
    if (texts[i][1]) made("small", cell, {textContent: texts[i][1]});
  });
}

function showValues() {
  for (const one of regions) fill(one.cells, one.values);
  const pointer = $("pointer");
  pointer.hidden = !pointed;
  if (pointed) put("where", `x ${pointed[0]}, y ${pointed[1]}`);
  fill(pointer.cells_, pointedValues);
  $("hint").hidden = regions.length > 0;
  put("commands", commands());
  plot();
}

// ---- traces -------------------------------------------------------------------------

// Values of AoP are placed by their distance from their common axis, modulo 180 degrees.
function axis(points) {
  let c = 0, s = 0;
  for (const p of points) {
    c += Math.cos(2 * p.aop_deg * Math.PI / 180);
    s += Math.sin(2 * p.aop_deg * Math.PI / 180);
  }
  return Math.atan2(s, c) * 90 / Math.PI;
}

function plot() {
  const {context, width, height} = sheet("plot");
  const all = regions.flatMap(one => one.trace), strips = [];
  if (all.length > 1) {
    const about = centre => deg => ((deg - centre + 270) % 180 + 180) % 180 - 90;
    const turns = all.some(p => Math.abs(about(axis(all))(p.aop_deg)) > 75);
    const middle = turns ? 90 : axis(all), from = about(middle);
    const curves = value => regions.map(one => [one.colour, one.trace, value]);
    strips.push(
      ["AoP", curves(p => from(p.aop_deg)), v => `${((v + middle + 360) % 180).toFixed(1)}\u00b0`],
      ["DoLP", curves(p => p.dolp), v => v.toPrecision(3)],
      ["S0", curves(p => p.s0), v => v.toPrecision(3)]);
  }
  if (rates.length > 1)
    strips.push(["Mev/s", [[ink("--dim"), rates, p => p.rate]], v => Math.max(v, 0).toPrecision(3)]);
  const drawn = strips.flatMap(([, curves]) => curves.map(([, points]) => points))
    .filter(points => points.length);
  if (!drawn.length) return;
  const first = Math.min(...drawn.map(points => points[0].t_us));
  const last = Math.max(...drawn.map(points => points.at(-1).t_us));
  const left = 74, tall = (height - 16) / strips.length;
  strips.forEach(([name, curves, text], k) => {
    let low = Infinity, high = -Infinity;
    for (const [, points, value] of curves)
      for (const p of points) { const v = value(p); low = Math.min(low, v); high = Math.max(high, v); }
    const pad = (high - low) * 0.05 || 0.5 * Math.abs(high) || 1;
    const y = v => k * tall + 8 + (tall - 16) * (high + pad - v) / (high - low + 2 * pad);
    context.strokeStyle = ink("--line");
    context.strokeRect(left, k * tall + 4, width - left - 1, tall - 8);
    context.fillStyle = ink("--ink");
    context.textAlign = "left";
    context.textBaseline = "middle";
    context.fillText(name, 0, (k + 0.5) * tall);
    context.fillStyle = ink("--dim");
    context.textAlign = "right";
    context.fillText(text(high), left - 5, k * tall + 10);
    context.fillText(text(low), left - 5, (k + 1) * tall - 10);
    for (const [colour, points, value] of curves) {
      context.strokeStyle = colour;
      context.lineWidth = 1.5;
      context.beginPath();
      let before = null;
      for (const p of points) {
        const v = value(p), x = left + (p.t_us - first) / (last - first || 1) * (width - left - 2);
        if (before === null || (name === "AoP" && Math.abs(v - before) > 90)) context.moveTo(x, y(v));
        else context.lineTo(x, y(v));
        before = v;
      }
      context.stroke();
      context.lineWidth = 1;
    }
  });
  context.fillStyle = ink("--dim");
  context.textBaseline = "bottom";
  context.textAlign = "right";
  context.fillText(clock(last), width - 2, height);
  context.textAlign = "left";
  context.fillText(clock(first), left, height);
}

// ---- exports ------------------------------------------------------------------------

function save(parts, kind, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob(parts, {type: kind}));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

function stem() { return status.name.replace(/\.[^.]*$/, ""); }

function csv() {
  const names = ["t_us", "pixels", "aop_deg", "aop_se_deg", "dolp", "dolp_se", "s0", "s0_se",
    "method"];
  const quoted = text => /[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  const lines = [["region", "x", "y", "width", "height", ...names].join(",")];
  for (const {name, box, trace} of regions)
    for (const p of trace)
      lines.push([quoted(name), ...box, ...names.map(key => p[key] ?? "")].join(","));
  save([lines.join("\n") + "\n"], "text/csv", stem() + "_regions.csv");
}

function geojson() {
  const features = regions.map(({name, box: [x, y, w, h]}) => ({type: "Feature",
    properties: {name}, geometry: {type: "Polygon", coordinates: [
      [[x, y], [x + w, y], [x + w, y + h], [x, y + h], [x, y]]]}}));
  save([JSON.stringify({type: "FeatureCollection", features}, null, 1)],
    "application/geo+json", stem() + "_regions.geojson");
}

// The same regions on the command line.
function commands() {
  if (!regions.length || !status.name || status.live) return "";
  const word = text => /^[\w.=,+-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`;
  const [x, y, w, h] = regions.at(-1).box, file = word(status.name);
  return [`pdavis tendon ${file} -o tendon`,
    ...regions.map(one => `--region ${word(`${one.name}=${one.box}`)}`)].join(" ")
    + `\npdavis fan ${file} -o fan.webm --centre ${x + w / 2},${y + h / 2} `
    + `--radius ${Math.min(w, h) / 2}`;
}
