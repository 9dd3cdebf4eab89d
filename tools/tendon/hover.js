// Point at the traces: a line at that time, and what each trace has there.
"use strict";
(() => {
  const picture = document.getElementById("traces"), box = picture.parentElement;
  const cursor = box.querySelector("i"), text = box.querySelector("pre");

  function nearest(times, t) {
    let low = 0, high = times.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (times[middle] < t) low = middle; else high = middle;
    }
    return t - times[low] < times[high] - t ? low : high;
  }

  function show(event) {
    const place = picture.getBoundingClientRect();
    const x = (event.clientX - place.left) / place.width;
    const y = (event.clientY - place.top) / place.height;
    const pane = PANES.find(p => x >= p.left && x <= p.right && y >= p.top && y <= p.bottom);
    cursor.hidden = text.hidden = !pane;
    if (!pane) return;
    const [first, last] = pane.span;
    const t = first + (x - pane.left) / (pane.right - pane.left) * (last - first);
    const rows = [`${t.toFixed(4)} s   ${pane.name}`];
    for (const line of pane.lines) {
      const i = nearest(line.t, t), value = line.values[i];
      if (value === null || value === undefined) continue;
      const se = line.se && line.se[i] !== null ? ` \u00b1 ${line.se[i]}` : "";
      rows.push(`${line.name}: ${value}${se}${pane.unit}`);
    }
    text.textContent = rows.join("\n");
    cursor.style.left = x * place.width + "px";
    cursor.style.top = pane.top * place.height + "px";
    cursor.style.height = (pane.bottom - pane.top) * place.height + "px";
    const right = x > 0.6;
    text.style.left = right ? "" : x * place.width + 12 + "px";
    text.style.right = right ? (1 - x) * place.width + 12 + "px" : "";
    text.style.top = pane.top * place.height + 4 + "px";
  }

  picture.onpointermove = show;
  picture.onpointerleave = () => { cursor.hidden = text.hidden = true; };
})();
