// Curves of a report: errors and NEES by time or by distance, with their bounds. A click shows the place in the map.
(function () {
  const panels = JSON.parse(document.getElementById("scene").textContent).curves, home = document.getElementById("panels");
  if (!home) return;
  const floats = (text) => new Float32Array(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
  const PALE = "#D9D9D9", GREY = "#6B6B6B", VERMILION = "#D55E00", FONT = "12px system-ui, sans-serif";
  const short = (v) => (v === 0 ? "0" : Math.abs(v) >= 1e5 || Math.abs(v) < 1e-3 ? v.toExponential(2) : String(Number(v.toPrecision(4))));
  // at most so many tick labels, so that they do not overlap
  const thin = (all, most) => all.filter((v, k) => k % Math.max(1, Math.ceil(all.length / most)) === 0);
  const power = (v) => (v < 1e-3 || v >= 1e5 ? v.toExponential(0) : short(v));
  let along = "t";  // t [s] since the path begins, or s [m] travelled
  const make = (tag, text) => { const x = document.createElement(tag); if (text) x.textContent = text; return x; };

  function steps(low, high, most) {  // round values between two
    const raw = Math.max(high - low, 1e-12) / most, ten = Math.pow(10, Math.floor(Math.log10(raw)));
    const step = ten * (raw / ten > 5 ? 10 : raw / ten > 2 ? 5 : raw / ten > 1 ? 2 : 1), out = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) out.push(Number((k * step).toPrecision(12)));
    return out;
  }
  function decades(low, high) {
    const out = [];
    for (let k = Math.ceil(Math.log10(low) - 1e-9); k <= Math.log10(high) + 1e-9; k++) out.push(Number(Math.pow(10, k).toPrecision(12)));
    return out.length > 1 ? out : [low, high];
  }
  function range(p) {  // of the values shown
    if (p.kind === "rows") {
      const all = p.rows.flatMap((r) => [r.value, r.low, r.high]).filter((v) => v > 0);
      return [Math.pow(10, Math.floor(Math.log10(Math.min(...all)))), Math.pow(10, Math.ceil(Math.log10(Math.max(...all))))];
    }
    let low = Infinity, high = -Infinity;
    const take = (v) => { if (!p.log || v > 0) { low = Math.min(low, v); high = Math.max(high, v); } };
    for (let k = 0; k < p.value.length; k++) {
      take(p.value[k]);
      if (p.half) { take(-p.half[k]); take(p.half[k]); }
    }
    for (const b of p.bounds || []) take(b);
    if (p.expected !== null) take(p.expected);
    if (p.log) {  // what is far below its bounds is as good as at the edge
      low = Math.max(low, p.bounds ? p.bounds[0] / 100 : low, high * 1e-8);
      return [Math.pow(10, Math.floor(Math.log10(low))), Math.pow(10, Math.ceil(Math.log10(high)))];
    }
    const rest = 0.05 * Math.max(high - low, 1e-9);
    return [low - (low < 0 ? rest : 0), high + rest];
  }
  const outside = (p, k) => (p.bounds ? p.value[k] < p.bounds[0] || p.value[k] > p.bounds[1] : p.half ? Math.abs(p.value[k]) > p.half[k] : false);

  function said(p, k) {
    const of = p.kind === "rows" ? p.rows[k].name : "t " + short(p.t[k]) + " s, " + short(p.s[k]) + " m";
    const v = p.kind === "rows" ? p.rows[k].value : p.value[k], unit = p.unit ? " " + p.unit : "";
    const b = p.kind === "rows" ? [p.rows[k].low, p.rows[k].high] : p.bounds;
    return of + ": " + short(v) + unit + (b ? " (" + short(b[0]) + " to " + short(b[1]) + ")" : p.half ? " (± " + short(p.half[k]) + unit + ")" : "");
  }

  function draw(p) {
    const c = p.canvas, ctx = c.getContext("2d"), ratio = window.devicePixelRatio || 1, w = c.clientWidth, h = c.clientHeight;
    if (!w || !h) return;
    c.width = Math.round(w * ratio); c.height = Math.round(h * ratio);
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.clearRect(0, 0, w, h);
    ctx.font = FONT; ctx.lineWidth = 1;
    if (p.kind === "rows") return drawRows(p, ctx, w, h);
    const box = { left: 52, right: w - 12, top: 8, bottom: h - 34 }, x = p[along];
    const [low, high] = range(p), end = Math.max(x[x.length - 1], 1e-9), begin = Math.min(x[0], 0);
    const flat = p.log ? Math.log10 : (v) => v, a = flat(low), b = flat(high);
    const u = (v) => box.left + (box.right - box.left) * (v - begin) / (end - begin);
    const y = (v) => box.bottom - (box.bottom - box.top) * ((p.log && v <= 0 ? a : flat(v)) - a) / (b - a);
    p.at = { u, y };
    ctx.save();
    ctx.beginPath(); ctx.rect(box.left, box.top, box.right - box.left, box.bottom - box.top); ctx.clip();
    ctx.fillStyle = PALE;
    if (p.bounds) ctx.fillRect(box.left, y(p.bounds[1]), box.right - box.left, y(p.bounds[0]) - y(p.bounds[1]));
    if (p.half && p.kind === "dots") for (let k = 0; k < x.length; k++) ctx.fillRect(u(x[k]) - 1, y(p.half[k]), 2, y(-p.half[k]) - y(p.half[k]));
    else if (p.half) for (const [i, j] of pieces(p)) {
      const tops = [], feet = [];
      for (let k = i; k < j; k++) { tops.push([u(x[k]), y(p.half[k])]); feet.unshift([u(x[k]), y(-p.half[k])]); }
      const edge = new Path2D("M" + [...tops, ...feet].map((q) => q.join(",")).join("L") + "Z");
      ctx.fill(edge);
    }
    if (p.expected !== null) { ctx.fillStyle = GREY; ctx.fillRect(box.left, y(p.expected) - 0.5, box.right - box.left, 1); }
    ctx.strokeStyle = p.colour; ctx.lineWidth = 1.4;
    if (p.kind === "line") for (const [i, j] of pieces(p)) {
      ctx.beginPath();
      for (let k = i; k < j; k++) ctx.lineTo(u(x[k]), y(p.value[k]));
      ctx.stroke();
    }
    for (let k = 0; k < x.length; k++) {  // what is outside its bounds is marked, also for eyes that see no colours
      const out = outside(p, k);
      if (p.kind === "line" && !out) continue;
      ctx.fillStyle = out ? VERMILION : p.colour;
      ctx.beginPath(); ctx.arc(u(x[k]), y(p.value[k]), out ? 2.6 : 2, 0, 7); ctx.fill();
    }
    if (p.chosen !== undefined && p.chosen !== null) {
      const k = p.chosen;
      ctx.fillStyle = "#000"; ctx.fillRect(u(x[k]) - 0.5, box.top, 1, box.bottom - box.top);
      ctx.beginPath(); ctx.arc(u(x[k]), y(p.value[k]), 4, 0, 7); ctx.fill();
    }
    ctx.restore();
    ctx.strokeStyle = GREY; ctx.lineWidth = 1;
    ctx.strokeRect(box.left, box.top, box.right - box.left, box.bottom - box.top);
    ctx.fillStyle = "#1a1a1a"; ctx.textAlign = "right"; ctx.textBaseline = "middle";
    const ticks = p.log ? thin(decades(low, high), (box.bottom - box.top) / 16) : steps(low, high, 5);
    for (const v of ticks) ctx.fillText(p.log ? power(v) : short(v), box.left - 6, y(v));
    ctx.textAlign = "center"; ctx.textBaseline = "top";
    for (const v of steps(begin, end, w > 450 ? 10 : 5)) ctx.fillText(short(v), u(v), box.bottom + 4);
    ctx.fillText(along === "t" ? "time since the path begins [s]" : "travelled [m]", 0.5 * (box.left + box.right), h - 14);
  }
  function drawRows(p, ctx, w, h) {
    const [low, high] = range(p), a = Math.log10(low), b = Math.log10(high), left = 12, right = w - 12;
    const u = (v) => left + (right - left) * (Math.log10(Math.max(v, low)) - a) / (b - a), each = (h - 26) / p.rows.length;
    p.rowAt = (v) => Math.floor(v / each);
    ctx.fillStyle = GREY; ctx.fillRect(u(1) - 0.5, 0, 1, h - 22);
    p.rows.forEach((r, k) => {
      const mid = each * (k + 0.7), out = r.value < r.low || r.value > r.high;
      ctx.fillStyle = PALE; ctx.fillRect(u(r.low), mid - 5, Math.max(u(r.high) - u(r.low), 2), 10);
      ctx.fillStyle = out ? VERMILION : p.colour || "#0072B2";
      ctx.beginPath(); ctx.arc(u(r.value), mid, 4, 0, 7); ctx.fill();
      ctx.fillStyle = "#1a1a1a"; ctx.textAlign = "left"; ctx.textBaseline = "bottom";
      ctx.fillText(r.name + "  " + short(r.value), left, mid - 7);
    });
    ctx.textAlign = "center"; ctx.textBaseline = "top"; ctx.fillStyle = "#1a1a1a";
    for (const v of thin(decades(low, high), (right - left) / 44)) ctx.fillText(power(v), Math.min(Math.max(u(v), 16), w - 16), h - 18);
  }
  function* pieces(p) {
    let i = 0;
    for (const j of [...(p.cut || []), p.value.length]) { yield [i, j]; i = j; }
  }
  function nearest(p, at) {  // by place along the axis; of several at one place the last
    const x = p[along];
    let best = 0;
    for (let k = 1; k < x.length; k++) if (Math.abs(p.at.u(x[k]) - at) <= Math.abs(p.at.u(x[best]) - at)) best = k;
    return best;
  }
  function choose(p, k) {
    p.chosen = k;
    p.out.textContent = k === null ? " " : said(p, k);
    if (p.kind !== "rows") draw(p);
  }
  function show(p) {
    if (p.kind === "rows" || p.chosen === null || p.chosen === undefined) return;
    const k = p.chosen, text = p.name + ", " + said(p, k);
    document.getElementById("view").dispatchEvent(new CustomEvent("place", { detail: { at: [...p.xyz.slice(3 * k, 3 * k + 3)], text } }));
  }

  for (const p of panels) {
    for (const key of ["t", "s", "xyz", "value", "half"]) if (p[key]) p[key] = floats(p[key]);
    const box = make("figure"), canvas = make("canvas"), out = make("output", " ");
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", p.name + ". " + p.said);
    if (p.kind === "rows") canvas.style.height = 26 + 36 * p.rows.length + "px";
    box.append(make("h3", p.name + (p.unit ? " [" + p.unit + "]" : "")), canvas, out, make("figcaption", p.said));
    home.append(box);
    Object.assign(p, { canvas, out });
    const point = (e) => choose(p, p.kind === "rows" ? Math.min(Math.max(p.rowAt(e.offsetY), 0), p.rows.length - 1) : nearest(p, e.offsetX));
    canvas.addEventListener("pointermove", point);
    canvas.addEventListener("click", (e) => { point(e); show(p); });
    canvas.addEventListener("pointerleave", () => choose(p, null));
    canvas.addEventListener("keydown", (e) => {
      const n = p.kind === "rows" ? p.rows.length : p.value.length, by = { ArrowLeft: -1, ArrowUp: -1, ArrowRight: 1, ArrowDown: 1 }[e.key];
      if (by) { e.preventDefault(); choose(p, Math.min(Math.max((p.chosen ?? -1) + by, 0), n - 1)); }
      if (e.key === "Enter") show(p);
    });
    new ResizeObserver(() => draw(p)).observe(canvas);
  }
  function axis(name) {
    along = name;
    for (const b of document.querySelectorAll("[data-along]")) b.setAttribute("aria-pressed", String(b.dataset.along === name));
    for (const p of panels) draw(p);
  }
  for (const b of document.querySelectorAll("[data-along]")) b.addEventListener("click", () => axis(b.dataset.along));
  axis("t");
})();
