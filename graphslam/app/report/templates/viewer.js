"use strict";
// The map of a report: layers that can be switched, from above or in space. No library, no network.
(function () {
  const data = JSON.parse(document.getElementById("scene").textContent);
  const canvas = document.getElementById("view"), ctx = canvas.getContext("2d");
  const floats = (text) => new Float32Array(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
  for (const layer of data.layers) {
    if (layer.xyz) layer.xyz = floats(layer.xyz);
    if (layer.cov) layer.cov = floats(layer.cov);
  }
  let low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  const robust = (layer) => layer.name === "path" || layer.name === "map" || layer.name === "landmarks";
  for (const layer of data.layers.filter((x) => x.xyz && robust(x)))
    for (let k = 0; k < layer.xyz.length; k++) {
      low[k % 3] = Math.min(low[k % 3], layer.xyz[k]);
      high[k % 3] = Math.max(high[k % 3], layer.xyz[k]);
    }
  const view = { mode: "2d", at: [0, 0, 0], scale: 1, yaw: -0.6, up: 0.6, loop: null, place: null, whole: true };

  function fit() {
    view.whole = true;
    view.at = low.map((a, k) => 0.5 * (a + high[k]));
    const span = Math.hypot(high[0] - low[0], high[1] - low[1]);
    const wide = view.mode === "2d" ? Math.max(high[0] - low[0], 1) : Math.max(span, 1);
    const tall = view.mode === "2d" ? Math.max(high[1] - low[1], 1)
      : Math.max(span * Math.sin(view.up) + (high[2] - low[2]) * Math.cos(view.up), 1);
    view.scale = 0.92 * Math.min(canvas.clientWidth / wide, canvas.clientHeight / tall);
    draw();
  }
  function axes() {  // rows of the projection: right and up of the screen
    if (view.mode === "2d") return [[1, 0, 0], [0, 1, 0]];
    const c = Math.cos(view.yaw), s = Math.sin(view.yaw), e = Math.sin(view.up), f = Math.cos(view.up);
    return [[c, -s, 0], [s * e, c * e, f]];
  }
  function projector() {
    const [r, u] = axes(), a = view.at, k = view.scale, w = canvas.clientWidth / 2, h = canvas.clientHeight / 2;
    return (x, y, z) => {
      const dx = x - a[0], dy = y - a[1], dz = z - a[2];
      return [w + k * (r[0] * dx + r[1] * dy), h - k * (u[0] * dx + u[1] * dy + u[2] * dz)];
    };
  }
  function draw() {
    const ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
    if (canvas.width !== Math.round(w * ratio)) canvas.width = Math.round(w * ratio);
    if (canvas.height !== Math.round(h * ratio)) canvas.height = Math.round(h * ratio);
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.clearRect(0, 0, w, h);
    const p = projector();
    for (const layer of data.layers) if (layer.on) paint[layer.kind](layer, p);
    if (view.loop) paintLoop(view.loop, p);
    if (view.place) paintPlace(view.place, p);
    scaleBar(w, h);
    canvas.dataset.drawn = String(Number(canvas.dataset.drawn || 0) + 1);
  }
  const paint = {
    points(layer, p) {
      const x = layer.xyz, half = layer.size / 2, storeys = layer.name === "map" && data.dim === 3;
      const range = Math.max(high[2] - low[2], 1e-9);
      ctx.fillStyle = layer.colour;
      for (let k = 0; k < x.length; k += 3) {
        const [u, v] = p(x[k], x[k + 1], x[k + 2]);
        if (u < -5 || v < -5 || u > canvas.clientWidth + 5 || v > canvas.clientHeight + 5) continue;
        if (storeys) {
          const t = Math.min(Math.max((x[k + 2] - low[2]) / range, 0), 1), g = Math.round(205 - 150 * t);
          ctx.fillStyle = "rgb(" + g + "," + g + "," + g + ")";
        }
        ctx.fillRect(u - half, v - half, layer.size, layer.size);
      }
    },
    line(layer, p) {
      const x = layer.xyz;
      ctx.strokeStyle = layer.colour; ctx.lineWidth = 1.8; ctx.setLineDash(layer.dashed ? [6, 4] : []);
      ctx.beginPath();
      for (let k = 0; k < x.length; k += 3) ctx.lineTo(...p(x[k], x[k + 1], x[k + 2]));
      ctx.stroke(); ctx.setLineDash([]);
    },
    ellipses(layer, p) {
      const x = layer.xyz, c = layer.cov;
      ctx.strokeStyle = layer.colour; ctx.lineWidth = 1;
      for (let k = 0; k < x.length; k += 3) {  // Cholesky factor maps the circle onto the ellipse
        const a = Math.sqrt(Math.max(c[k], 0)), b = a > 0 ? c[k + 1] / a : 0, d = Math.sqrt(Math.max(c[k + 2] - b * b, 0));
        ctx.beginPath();
        for (let t = 0; t <= 32; t++) {
          const u = Math.cos(t * Math.PI / 16), v = Math.sin(t * Math.PI / 16);
          ctx.lineTo(...p(x[k] + a * u, x[k + 1] + b * u + d * v, x[k + 2]));
        }
        ctx.stroke();
      }
    },
    loops(layer, p) {
      ctx.strokeStyle = layer.colour; ctx.lineWidth = 2;
      for (const r of layer.rows) {
        const a = p(...r.a), b = p(...r.b);
        ctx.beginPath(); ctx.moveTo(...a); ctx.lineTo(...b); ctx.stroke();
        for (const q of [a, b]) { ctx.beginPath(); ctx.arc(...q, 3.5, 0, 7); ctx.stroke(); }
      }
    },
  };
  function paintLoop(r, p) {
    const a = p(...r.a), b = p(...r.b);
    for (const [colour, width] of [["#fff", 9], ["#000", 5], ["#F0E442", 2.5]]) {
      ctx.strokeStyle = colour; ctx.lineWidth = width;
      ctx.beginPath(); ctx.moveTo(...a); ctx.lineTo(...b); ctx.stroke();
      for (const q of [a, b]) { ctx.beginPath(); ctx.arc(...q, 8, 0, 7); ctx.stroke(); }
    }
    ctx.fillStyle = "#000"; ctx.font = "bold 13px system-ui, sans-serif";
    ctx.fillText("loop " + r.loop, 0.5 * (a[0] + b[0]) + 12, 0.5 * (a[1] + b[1]) - 10);
  }
  function paintPlace(place, p) {
    const q = p(...place.at);
    for (const [colour, width] of [["#fff", 9], ["#000", 5], ["#F0E442", 2.5]]) {
      ctx.strokeStyle = colour; ctx.lineWidth = width;
      ctx.beginPath(); ctx.arc(...q, 9, 0, 7); ctx.stroke();
    }
    ctx.fillStyle = "#000"; ctx.font = "bold 13px system-ui, sans-serif";
    const wide = ctx.measureText(place.text).width, x = Math.max(Math.min(q[0] + 14, canvas.clientWidth - wide - 6), 6);
    ctx.fillText(place.text, x, Math.max(q[1] - 16, 16));
  }
  function scaleBar(w, h) {
    const wanted = 0.22 * w / view.scale, ten = Math.pow(10, Math.floor(Math.log10(wanted)));
    const metres = ten * (wanted / ten >= 5 ? 5 : wanted / ten >= 2 ? 2 : 1), y = h - 12;
    ctx.strokeStyle = ctx.fillStyle = "#000"; ctx.lineWidth = 2;
    ctx.beginPath(); ctx.moveTo(12, y - 5); ctx.lineTo(12, y); ctx.lineTo(12 + metres * view.scale, y);
    ctx.lineTo(12 + metres * view.scale, y - 5); ctx.stroke();
    ctx.font = "12px system-ui, sans-serif"; ctx.fillText(metres + " m", 16, y - 8);
  }
  function zoom(factor, u, v) {
    const [r, up] = axes(), du = (u - canvas.clientWidth / 2) / view.scale, dv = (canvas.clientHeight / 2 - v) / view.scale;
    const keep = 1 - 1 / factor;
    move(du * keep, dv * keep, r, up);
    view.whole = false;
    view.scale *= factor;
    draw();
  }
  function move(du, dv, r, up) {  // along the screen, in metres
    view.whole = false;
    for (let k = 0; k < 3; k++) view.at[k] += du * r[k] + dv * up[k];
  }
  const fingers = new Map();
  canvas.addEventListener("pointerdown", (e) => { canvas.setPointerCapture(e.pointerId); fingers.set(e.pointerId, [e.offsetX, e.offsetY]); });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => fingers.delete(e.pointerId));
  canvas.addEventListener("pointermove", (e) => {
    const old = fingers.get(e.pointerId);
    if (!old) return;
    const now = [e.offsetX, e.offsetY], other = [...fingers].filter(([id]) => id !== e.pointerId).map(([, q]) => q)[0];
    const dx = now[0] - old[0], dy = now[1] - old[1];
    fingers.set(e.pointerId, now);
    if (other) {
      const before = Math.hypot(old[0] - other[0], old[1] - other[1]), after = Math.hypot(now[0] - other[0], now[1] - other[1]);
      if (before > 0 && after > 0) zoom(after / before, 0.5 * (now[0] + other[0]), 0.5 * (now[1] + other[1]));
    } else if (view.mode === "3d" && !e.shiftKey) {
      view.yaw += 0.008 * dx;
      view.up = Math.min(Math.max(view.up + 0.008 * dy, 0.02), Math.PI / 2);
      draw();
    } else {
      move(-dx / view.scale, dy / view.scale, ...axes());
      draw();
    }
  });
  canvas.addEventListener("wheel", (e) => { e.preventDefault(); zoom(Math.exp(-0.0015 * e.deltaY), e.offsetX, e.offsetY); }, { passive: false });
  canvas.addEventListener("keydown", (e) => {
    const step = 40 / view.scale, by = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] }[e.key];
    if (by) { e.preventDefault(); move(...by, ...axes()); draw(); }
    if (e.key === "+" || e.key === "-") zoom(e.key === "+" ? 1.25 : 0.8, canvas.clientWidth / 2, canvas.clientHeight / 2);
  });
  const boxes = document.getElementById("layers");
  data.layers.forEach((layer, k) => {
    const label = document.createElement("label"), box = document.createElement("input"), dot = document.createElement("span");
    box.type = "checkbox"; box.checked = layer.on; box.dataset.layer = String(k);
    box.addEventListener("change", () => { layer.on = box.checked; draw(); });
    dot.className = "dot"; dot.style.background = layer.colour;
    label.append(box, dot, layer.name);
    boxes.append(label);
  });
  function mode(name) {
    view.mode = name;
    for (const b of document.querySelectorAll("[data-mode]")) b.setAttribute("aria-pressed", String(b.dataset.mode === name));
    fit();
  }
  for (const b of document.querySelectorAll("[data-mode]")) b.addEventListener("click", () => mode(b.dataset.mode));
  document.getElementById("fit").addEventListener("click", fit);
  const all = new Map(data.layers.filter((x) => x.kind === "loops").flatMap((x) => x.rows.map((r) => [String(r.loop), r])));
  function show(row) {
    const r = all.get(row.dataset.loop);
    if (!r) return;
    for (const other of document.querySelectorAll("tr.chosen")) other.classList.remove("chosen");
    row.classList.add("chosen");
    view.loop = r;
    view.whole = false;
    view.at = r.a.map((x, k) => 0.5 * (x + r.b[k]));
    const apart = Math.hypot(...r.a.map((x, k) => x - r.b[k]));
    view.scale = 0.4 * Math.min(canvas.clientWidth, canvas.clientHeight) / Math.max(apart, 10);
    draw();
    canvas.dataset.loop = String(r.loop);
    document.getElementById("map").scrollIntoView({ block: "start" });
  }
  for (const row of document.querySelectorAll("tr[data-loop]")) {
    row.tabIndex = 0;
    row.addEventListener("click", () => show(row));
    row.addEventListener("keydown", (e) => { if (e.key === "Enter") show(row); });
  }
  canvas.addEventListener("place", (e) => {  // a point of a curve was clicked
    view.place = e.detail;
    const [u, v] = projector()(...e.detail.at);
    if (u < 0 || v < 0 || u > canvas.clientWidth || v > canvas.clientHeight) {
      view.at = e.detail.at;
      view.whole = false;
    }
    draw();
    canvas.dataset.place = e.detail.text;
    document.getElementById("map").scrollIntoView({ block: "start" });
  });
  new ResizeObserver(() => (view.whole ? fit() : draw())).observe(canvas);
  mode("2d");
})();
