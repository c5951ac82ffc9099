"use strict";
// Everything on the page is made here from one block of data. Its texts come from files of strangers:
// they become text nodes and attributes, never markup.

const SVG = "http://www.w3.org/2000/svg";
const NEAR_M = 0.3; // a camera's lines are cut at this depth
const RING_GAP_CM = 10; // a line whose ends are no farther apart is a ring
const MASK_PX_PER_M = 4;
const data = JSON.parse(document.getElementById("data").textContent);
const pair = data.results.length === 2;
const state = { score: data.score, shown: 0, frame: null, order: [], class: -1, scene: "", token: "" };
const cards = [];
const picks = []; // the drawings on the first screen
let opened = []; // the drawings of the frame that is open

function byId(id) {
  return document.getElementById(id);
}

function make(tag, attributes = {}, ...children) {
  const made = tag.startsWith("svg:")
    ? document.createElementNS(SVG, tag.slice(4))
    : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

// ---- figures ----

function table({ caption, head, rows }) {
  const cells = (row, tag) => row.map((text, i) =>
    i ? make(tag, {}, text) : make("th", { scope: tag === "th" ? "col" : "row" }, text));
  return make("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": caption },
    make("table", {}, make("caption", {}, caption),
      make("thead", {}, make("tr", {}, ...cells(head, "th"))),
      make("tbody", {}, ...rows.map((row) => make("tr", {}, ...cells(row, "td"))))));
}

function curvePanel(panel, across, up) {
  const of = data.classes[panel.class];
  const name = `${panel.metric}, ${of.title}`;
  const plot = make("svg:svg", { viewBox: "-36 -8 246 246", role: "img", "aria-label": `${name}: ${up} over ${across}` });
  for (const at of [0, 50, 100]) {
    plot.append(
      make("svg:path", { class: "axis", d: `M0 ${200 - 2 * at}H200M${2 * at} 0V200` }),
      make("svg:text", { x: -5, y: 204 - 2 * at, "text-anchor": "end" }, String(at)),
      make("svg:text", { x: 2 * at, y: 214, "text-anchor": "middle" }, String(at)));
  }
  plot.append(
    make("svg:text", { x: 100, y: 230, "text-anchor": "middle" }, `${across} (%)`),
    make("svg:text", { transform: "translate(-26 100) rotate(-90)", "text-anchor": "middle" }, `${up} (%)`));
  const legend = make("ul", {});
  panel.lines.forEach((line, i) => {
    const opacity = 0.3 + (0.7 * (i + 1)) / panel.lines.length;
    line.points.forEach((points, r) => {
      const d = points.map(([recall, precision]) => `${200 * recall} ${200 - 200 * precision}`).join("L");
      if (d) plot.append(make("svg:path", { class: `curve result${r}`, color: of.colour, opacity, d: `M${d}` }));
    });
    const swatch = make("span", { class: "swatch" });
    swatch.style.setProperty("background", of.colour);
    swatch.style.setProperty("opacity", opacity);
    legend.append(make("li", {}, swatch, `${line.label}: ${line.ap.join(" | ")}`));
  });
  return make("figure", {}, make("figcaption", {}, name), plot, legend);
}

// ---- what a score threshold makes of a frame ----

function chosen(item) {
  return state.class < 0 || item.c === state.class;
}

function counts(frame, r) {
  const kept = frame.found[r].filter((item) => item.s >= state.score && chosen(item));
  const hits = kept.filter((item) => item.hit >= 0).length;
  return { hits, wrong: kept.length - hits, missed: frame.truth.filter(chosen).length - hits };
}

function f1({ hits, wrong, missed }) {
  const total = 2 * hits + wrong + missed;
  return total ? (100 * 2 * hits) / total : 100;
}

function sentence(count) {
  return `${count.hits} hits, ${count.wrong} false, ${count.missed} missed, F1\u00a0${f1(count).toFixed(0)}\u00a0%`;
}

function fate(item, r, reached) {
  if (!chosen(item)) return "below";
  if (item.s === undefined) return r === null ? "truth" : reached.has(item) ? "truth got" : "truth missed";
  return item.s < state.score ? "below" : item.hit >= 0 ? "hit" : "false";
}

// A drawing is what shows one frame and one result (or none, null) somewhere on the page.
function restyle(drawing) {
  const { frame, r, parts } = drawing;
  const kept = r === null ? [] : frame.found[r].filter((item) => item.s >= state.score && item.hit >= 0);
  const reached = new Set(kept.map((item) => frame.truth[item.hit]));
  for (const [node, item, kind] of parts) node.setAttribute("class", `${kind} ${fate(item, r, reached)}`);
  if (drawing.mask) drawing.mask.setAttribute("href", document.body.classList.contains("hide-mask") ? "" : maskPicture(frame.found[r]));
  if (drawing.caption) drawing.caption.textContent = r === null ? "" : sentence(counts(frame, r));
}

function shapes(frame, r, parts, path, named = true) {
  const found = r === null ? [] : [...frame.found[r]].reverse(); // the surest on top
  const drawn = [];
  for (const item of [...frame.truth, ...found]) {
    const of = data.classes[item.c];
    const d = path(item);
    if (!d) continue;
    const node = make("svg:path", { d, color: of.colour, "fill-opacity": of.area ? 0.18 : 0 });
    if (named) node.append(make("svg:title", {}, `${of.title}, ${item.s === undefined ? "ground truth" : `score ${item.s.toFixed(2)}`}`));
    parts.push([node, item, item.s === undefined ? "line" : "line found"]);
    drawn.push(node);
  }
  return drawn;
}

function changeShapes(frame, named) {
  return frame.changes.map((item) => {
    const node = make("svg:path", { class: `change ${item.kind}`, d: flat(item) });
    if (named) node.append(make("svg:title", {}, item.text));
    return node;
  });
}

// ---- bird's-eye view: metres, to the right and ahead ----

function flat(item) {
  const p = item.p;
  let d = "";
  for (let i = 0; i < p.length; i += 2) d += `${i ? "L" : "M"}${p[i] / 100} ${-p[i + 1] / 100}`;
  return d;
}

function ellipses(item) {
  const group = make("svg:g", { color: data.classes[item.c].colour });
  for (let i = 0, k = 0; i < item.p.length; i += 2, k += 3) {
    const [x, y] = [item.p[i] / 100, -item.p[i + 1] / 100];
    group.append(make("svg:ellipse", {
      cx: x, cy: y, rx: item.g[k] / 100, ry: item.g[k + 1] / 100, transform: `rotate(${-item.g[k + 2]} ${x} ${y})`,
    }));
  }
  return group;
}

// 1 - prod (1 - G_i) (GSMap Eq. 6) on pixels, row 0 ahead: what render_gaussians computes.
function occupancy(item, [left, , , top], width, height) {
  const free = new Float32Array(width * height).fill(1);
  for (let i = 0, k = 0; i < item.p.length; i += 2, k += 3) {
    const [x, y] = [item.p[i] / 100, item.p[i + 1] / 100];
    const [sx, sy, angle] = [item.g[k] / 100, item.g[k + 1] / 100, (item.g[k + 2] * Math.PI) / 180];
    const [cos, sin, reach] = [Math.cos(angle), Math.sin(angle), 4 * Math.max(sx, sy)];
    const column = (at) => Math.round(MASK_PX_PER_M * (at - left));
    const row = (at) => Math.round(MASK_PX_PER_M * (top - at));
    for (let v = Math.max(row(y + reach), 0); v < Math.min(row(y - reach), height); v++) {
      for (let u = Math.max(column(x - reach), 0); u < Math.min(column(x + reach), width); u++) {
        const dx = left + (u + 0.5) / MASK_PX_PER_M - x;
        const dy = top - (v + 0.5) / MASK_PX_PER_M - y;
        const [along, across] = [(cos * dx + sin * dy) / sx, (cos * dy - sin * dx) / sy];
        free[v * width + u] *= 1 - Math.exp(-0.5 * (along * along + across * across));
      }
    }
  }
  return free.map((value) => 1 - value);
}

function maskPicture(found) {
  const [left, right, bottom, top] = data.extent;
  const [width, height] = [right - left, top - bottom].map((size) => Math.round(MASK_PX_PER_M * size));
  const canvas = make("canvas", { width, height });
  const context = canvas.getContext("2d");
  const picture = context.createImageData(width, height);
  data.classes.forEach((of, c) => {
    const rgb = [1, 3, 5].map((i) => parseInt(of.colour.slice(i, i + 2), 16));
    const cover = new Float32Array(width * height);
    for (const item of found.filter((each) => each.c === c && each.g && each.s >= state.score)) {
      occupancy(item, data.extent, width, height).forEach((value, i) => { cover[i] = Math.max(cover[i], value); });
    }
    cover.forEach((a, i) => {
      const below = (picture.data[4 * i + 3] / 255) * (1 - a);
      for (let k = 0; a && k < 3; k++) picture.data[4 * i + k] = (a * rgb[k] + below * picture.data[4 * i + k]) / (a + below);
      picture.data[4 * i + 3] = 255 * (a + below);
    });
  });
  context.putImageData(picture, 0, 0);
  return canvas.toDataURL();
}

// A score stands on its line, clear of the car, the border and the scores before it.
function scoreLabel(item, taken) {
  const [left, right, bottom, top] = data.extent;
  const size = (right - left) / 24;
  const [rear, front, width] = data.vehicle;
  const clear = ([x, y]) => x > left + size && x < right - size && y > bottom + size && y < top - size
    && !(Math.abs(x) < width / 2 + size && y > rear - size && y < front + size)
    && taken.every(([a, b]) => Math.abs(a - x) > 2.6 * size || Math.abs(b - y) > size);
  const last = item.p.length / 2 - 1;
  const at = [0.5, 0.3, 0.7, 0.4, 0.6, 0.2, 0.8, 0.1, 0.9]
    .map((share) => 2 * Math.round(share * last))
    .map((i) => [item.p[i] / 100, item.p[i + 1] / 100]).find(clear);
  if (!at) return null;
  taken.push(at);
  return make("svg:text", { x: at[0], y: -at[1], "font-size": size, dy: "0.35em", color: data.classes[item.c].colour },
    item.s.toFixed(2));
}

function ground(labelled) {
  const [left, right, bottom, top] = data.extent;
  const [rear, front, width] = data.vehicle;
  const drawn = [make("svg:rect", { class: "ground", x: left, y: -top, width: right - left, height: top - bottom })];
  const size = (right - left) / 22;
  for (let at = 10 * Math.ceil(Math.min(left, bottom) / 10); at <= Math.max(right, top); at += 10) {
    const text = `${String(at).replace("-", "\u2212")} m`;
    if (at > left && at < right) {
      drawn.push(make("svg:path", { class: "axis", d: `M${at} ${-top}V${-bottom}` }));
      if (labelled) drawn.push(make("svg:text", { class: "tick", x: at, y: -bottom - 0.4 * size, "font-size": size, "text-anchor": "middle" }, text));
    }
    if (at > bottom && at < top) {
      drawn.push(make("svg:path", { class: "axis", d: `M${left} ${-at}H${right}` }));
      if (labelled) drawn.push(make("svg:text", { class: "tick", x: left + 0.3 * size, y: -at - 0.3 * size, "font-size": size }, text));
    }
  }
  const glass = -front + 0.3 * (front - rear); // the windscreen: the car has a front
  drawn.push(make("svg:rect", { class: "car", x: -width / 2, y: -front, width, height: front - rear, rx: 0.5 }));
  drawn.push(make("svg:path", { class: "glass", d: `M${-0.36 * width} ${glass}H${0.36 * width}L${0.28 * width} ${glass + 0.7}H${-0.28 * width}Z` }));
  return drawn;
}

function birdsEye(frame, r, large) {
  const [left, right, bottom, top] = data.extent;
  const drawing = { frame, r, parts: [] };
  const view = make("svg:svg", { class: "bev", viewBox: `${left} ${-top} ${right - left} ${top - bottom}` }, ...ground(large));
  drawing.view = view;
  const lines = shapes(frame, r, drawing.parts, flat, large);
  if (large && r !== null) {
    if (frame.found[r].some((item) => item.g)) {
      drawing.mask = make("svg:image", { class: "mask", x: left, y: -top, width: right - left, height: top - bottom, preserveAspectRatio: "none" });
      view.append(drawing.mask);
    }
    for (const item of frame.found[r].filter((each) => each.g)) {
      const group = ellipses(item);
      drawing.parts.push([group, item, "gauss"]);
      view.append(group);
    }
  }
  view.append(...lines, ...changeShapes(frame, large));
  const taken = [];
  for (const item of large && r !== null ? frame.found[r] : []) {
    const label = scoreLabel(item, taken);
    if (label) drawing.parts.push([label, item, "score"]);
    if (label) view.append(label);
  }
  return drawing;
}

// ---- cameras ----

function projected(item, m) {
  let h = [];
  for (let i = 0; i < item.p.length; i += 2) {
    const [x, y] = [item.p[i] / 100, item.p[i + 1] / 100];
    h.push([0, 3, 6].map((row) => m[row] * x + m[row + 1] * y + m[row + 2]));
  }
  const hidden = h.findIndex((point) => point[2] < NEAR_M);
  // A ring starts at a hidden point, so that its visible part is one path. An open line has no edge from its end to its start.
  const last = item.p.length - 2;
  const gap = Math.hypot(item.p[last] - item.p[0], item.p[last + 1] - item.p[1]);
  const isRing = data.classes[item.c].area && gap <= RING_GAP_CM;
  if (isRing && hidden > 0) h = [...h.slice(hidden), ...h.slice(gap ? 0 : 1, hidden + 1)];
  const pixel = (point) => `${(point[0] / point[2]).toFixed(1)} ${(point[1] / point[2]).toFixed(1)}`;
  let d = "";
  for (let i = 1; i < h.length; i++) {
    const [a, b] = [h[i - 1], h[i]];
    if (Math.max(a[2], b[2]) < NEAR_M) continue;
    const share = (NEAR_M - a[2]) / (b[2] - a[2]);
    const cut = a.map((value, k) => value + share * (b[k] - value));
    if (!d || a[2] < NEAR_M) d += `M${pixel(a[2] < NEAR_M ? cut : a)}`;
    d += `L${pixel(b[2] < NEAR_M ? cut : b)}`;
  }
  return d;
}

function cameraView(camera, src, frame, r) {
  const [width, height] = camera.size;
  const drawing = { frame, r, parts: [] };
  drawing.view = make("svg:svg", { class: "camera", viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `camera ${camera.title}` });
  if (src) drawing.view.append(make("svg:image", { href: src, width, height, preserveAspectRatio: "none" }));
  drawing.view.append(...shapes(frame, r, drawing.parts, (item) => projected(item, camera.matrix)));
  return drawing;
}

// ---- the page ----

function shownResult() {
  return data.results.length ? state.shown : null;
}

// The best, the typical (median) and the worst of the frames that the filters leave.
function drawPicks() {
  picks.length = 0;
  const order = data.results.length ? visible() : [];
  order.sort((a, b) => f1(counts(data.frames[b], state.shown)) - f1(counts(data.frames[a], state.shown)) || a - b);
  const places = { Best: 0, Typical: order.length >> 1, Worst: order.length - 1 };
  byId("picks").replaceChildren(...Object.entries(places).slice(0, order.length).map(([name, at]) => {
    const frame = data.frames[order[at]];
    const map = birdsEye(frame, shownResult(), false);
    const count = counts(frame, state.shown);
    const said = make("div", {}, make("strong", {}, name),
      make("span", { class: "figure" }, `F1 ${f1(count).toFixed(0)}\u00a0%`),
      make("span", { class: "quiet" }, `${count.hits} hits, ${count.wrong} false, ${count.missed} missed. ${frame.title}`));
    picks.push(map);
    const front = (frame.cameras[0] || [])[(frame.cameras[0] || []).length >> 1];
    if (front) {
      const camera = cameraView(front, imagesOf(order[at])[frame.cameras[0].length >> 1], frame, shownResult());
      picks.push(camera);
      said.prepend(camera.view);
    }
    return make("a", { class: "pick", href: `#frame-${order[at]}`, "aria-label": `${name} frame: ${frame.title}` }, map.view, said);
  }));
  picks.forEach(restyle);
}

function refresh() {
  byId("score-value").textContent = state.score.toFixed(2);
  picks.forEach(restyle);
  for (const card of cards) {
    restyle(card);
    const values = data.results.map((_, r) => f1(counts(card.frame, r)).toFixed(0));
    card.value.textContent = values.length ? `F1 ${values.join(" | ")} %` : "";
  }
  opened.forEach(restyle);
  byId("totals").textContent = !state.order.length
    ? "The filters leave no frame: there is nothing to score."
    : data.results.map((name, r) => {
    const sum = { hits: 0, wrong: 0, missed: 0 };
    for (const i of state.order) {
      const count = counts(data.frames[i], r);
      for (const key of Object.keys(sum)) sum[key] += count[key];
    }
    return `${name}: ${sentence(sum)}`;
  }).join("; ") + ` (${state.order.length} of the ${data.frames.length} frames on this page, within ${data.match_m.toFixed(1)} m).`;
}

function visible() {
  const words = state.token.trim().toLowerCase();
  return data.frames.map((_, i) => i).filter((i) => {
    const { scene, token, title } = data.frames[i];
    return (!state.scene || scene === state.scene) && `${token} ${title}`.toLowerCase().includes(words);
  });
}

function sortCards() {
  const how = byId("order").value;
  const value = (frame, r) => f1(counts(frame, r));
  const key = {
    time: () => 0,
    worst: (frame) => value(frame, state.shown),
    best: (frame) => -value(frame, state.shown),
    gain: (frame) => value(frame, 0) - value(frame, 1),
    loss: (frame) => value(frame, 1) - value(frame, 0),
  }[how];
  const keys = data.frames.map(key);
  state.order = visible().sort((a, b) => keys[a] - keys[b] || a - b);
  byId("grid").replaceChildren(...state.order.map((i) => cards[i].link));
  drawPicks();
}

// Small maps are drawn when they come near the window.
const nearby = new IntersectionObserver((entries) => {
  for (const { isIntersecting, target } of entries) {
    const card = isIntersecting && cards.find((each) => each.link === target);
    if (!card || card.view) continue;
    Object.assign(card, birdsEye(card.frame, shownResult(), false));
    card.view.setAttribute("aria-hidden", "true");
    target.firstChild.replaceWith(card.view);
    restyle(card);
  }
}, { rootMargin: "600px" });

function drawCards() {
  nearby.disconnect();
  cards.length = 0;
  data.frames.forEach((frame, i) => {
    const value = make("span", { class: "value" });
    const link = make("a", { class: "card", href: `#frame-${i}` }, make("div", { class: "bev" }), make("span", {}, frame.title), value);
    cards.push({ frame, r: shownResult(), parts: [], value, link });
    nearby.observe(link);
  });
  sortCards();
}

function imagesOf(index) {
  return JSON.parse(document.getElementsByClassName("images")[index].textContent);
}

// The camera ahead is large, the others stand in a row below it; a portrait stays in its row.
function cameraRows(rows) {
  const all = rows.flat();
  const middle = rows.length ? rows[0].length >> 1 : 0;
  const wide = all.length > 2 && all[middle].size[0] > all[middle].size[1];
  if (!wide) return rows.map((row) => ["row", row]);
  return [["row", [all[middle]]], ["row strip", all.filter((_, i) => i !== middle)]];
}

function drawFrame() {
  const frame = data.frames[state.frame];
  document.title = `${frame.title}, ${data.title}`;
  byId("frame-title").textContent = frame.title;
  byId("frame-token").textContent = [frame.place, `sample ${frame.token}`].filter(Boolean).join(", ");
  if (!state.order.includes(state.frame)) state.order = data.frames.map((_, i) => i);
  byId("position").textContent = `${state.order.indexOf(state.frame) + 1} of ${state.order.length}`;
  opened = [];
  const images = new Map(frame.cameras.flat().map((camera, i) => [camera, imagesOf(state.frame)[i]]));
  const rows = cameraRows(frame.cameras).map(([kind, row]) => {
    const line = make("div", { class: kind });
    for (const camera of row) {
      const drawing = cameraView(camera, images.get(camera), frame, shownResult());
      opened.push(drawing);
      line.append(make("figure", {}, drawing.view, make("figcaption", {}, camera.title)));
    }
    return line;
  });
  byId("cameras").replaceChildren(...rows);
  const maps = (data.results.length ? data.results : ["Ground truth"]).map((name, i) => {
    const drawing = birdsEye(frame, data.results.length ? i : null, true);
    drawing.view.setAttribute("role", "img");
    drawing.view.setAttribute("aria-label", `${name}, bird's-eye view`);
    drawing.caption = make("span", { class: "quiet" });
    opened.push(drawing);
    return make("figure", {}, make("figcaption", {}, make("strong", {}, name), drawing.caption), drawing.view);
  });
  byId("maps").replaceChildren(...maps);
  opened.forEach(restyle);
}

// ---- one picture enlarged ----

function enlarge(view) {
  const copy = view.cloneNode(true);
  byId("zoom-title").textContent = view.getAttribute("aria-label");
  byId("zoomed").replaceChildren(copy);
  byId("zoom").showModal();
}

function zoomBy(factor, at) {
  const box = byId("zoomed").firstChild.viewBox.baseVal;
  const [x, y] = at || [box.x + box.width / 2, box.y + box.height / 2];
  byId("zoomed").firstChild.setAttribute("viewBox",
    `${x - (x - box.x) * factor} ${y - (y - box.y) * factor} ${box.width * factor} ${box.height * factor}`);
}

function under(event) { // the place of the picture under the pointer
  const view = byId("zoomed").firstChild;
  const { x, y } = new DOMPoint(event.clientX, event.clientY).matrixTransform(view.getScreenCTM().inverse());
  return [x, y];
}

function startZoom() {
  for (const id of ["cameras", "maps"]) {
    byId(id).addEventListener("click", (event) => {
      const view = event.target.closest("svg");
      if (view) enlarge(view);
    });
  }
  const whole = () => {
    const [first] = opened.filter((drawing) => drawing.view.getAttribute("aria-label") === byId("zoom-title").textContent);
    byId("zoomed").firstChild.setAttribute("viewBox", first.view.getAttribute("viewBox"));
  };
  byId("closer").addEventListener("click", () => zoomBy(0.7));
  byId("farther").addEventListener("click", () => zoomBy(1 / 0.7));
  byId("whole").addEventListener("click", whole);
  byId("close").addEventListener("click", () => byId("zoom").close());
  byId("zoomed").addEventListener("wheel", (event) => {
    event.preventDefault();
    zoomBy(event.deltaY < 0 ? 0.85 : 1 / 0.85, under(event));
  }, { passive: false });
  let held = null;
  byId("zoomed").addEventListener("pointerdown", (event) => { held = under(event); });
  byId("zoomed").addEventListener("pointermove", (event) => {
    if (!held || !event.buttons) return;
    const [x, y] = under(event);
    const box = byId("zoomed").firstChild.viewBox.baseVal;
    byId("zoomed").firstChild.setAttribute("viewBox", `${box.x + held[0] - x} ${box.y + held[1] - y} ${box.width} ${box.height}`);
  });
}

function drawLegend() {
  const match = data.results.length && byId("colour").value === "match";
  const lines = match
    ? [["hit", "hit"], ["false", "false prediction"], ["found", "truth found"], ["missed", "truth missed"]]
      .map(([key, text]) => [data.match_colours[key], text, `sign-${key}`])
    : data.classes.filter((_, c) => data.frames.some((frame) => [frame.truth, ...frame.found].some((items) => items.some((item) => item.c === c))))
      .map((of) => [of.colour, of.title, ""]);
  for (const kind of ["removed", "added", "moved"]) {
    if (data.frames.some((frame) => frame.changes.some((item) => item.kind === kind))) lines.push([null, kind, `change ${kind}`]);
  }
  byId("legend").replaceChildren(...lines.map(([colour, text, kind]) => {
    const swatch = make("span", { class: `swatch ${kind}` });
    if (colour) swatch.style.setProperty("color", colour);
    return make("li", {}, swatch, text);
  }));
}

function route() {
  const index = Number((location.hash.match(/^#frame-(\d+)$/) || [])[1] ?? NaN);
  const before = state.frame;
  state.frame = index < data.frames.length ? index : null;
  const open = state.frame !== null;
  document.body.classList.toggle("open", open);
  byId("frame").hidden = byId("panels").hidden = !open;
  byId("figures").hidden = open || !data.tables.length;
  byId("grid").hidden = byId("frames").hidden = open;
  if (byId("zoom").open) byId("zoom").close();
  if (open) {
    drawFrame();
    if (before === null) scrollTo(0, 0);
    byId("frame-title").focus({ preventScroll: before !== null });
  } else {
    opened = [];
    document.title = data.title;
    if (before !== null) cards[before].link.focus();
  }
}

function step(by) {
  const at = state.order.indexOf(state.frame) + by;
  if (at >= 0 && at < state.order.length) location.replace(`#frame-${state.order[at]}`);
}

function onKey(event) {
  const { key, target } = event;
  if (event.altKey || event.ctrlKey || event.metaKey || byId("zoom").open || target.matches("select, input, .scroll")) return;
  const by = { ArrowLeft: -1, ArrowRight: 1 }[key];
  if (state.frame !== null) {
    if (by) step(by);
    if (key === "Escape") location.hash = "#frames";
  } else if (target.matches(".card")) {
    const all = [...byId("grid").children];
    const columns = all.filter((card) => card.offsetTop === all[0].offsetTop).length;
    const move = by || { ArrowUp: -columns, ArrowDown: columns }[key];
    const next = move && all[all.indexOf(target) + move];
    if (!next) return;
    next.focus();
    event.preventDefault();
  }
}

function start() {
  document.title = byId("title").textContent = data.title;
  byId("notes").textContent = data.notes.join(" ");
  const scored = data.results.length > 0;
  document.body.classList.toggle("no-results", !scored);
  document.body.classList.toggle("no-pair", !pair);
  document.body.classList.toggle("no-changes", !data.frames.some((frame) => frame.changes.length));
  document.body.classList.toggle("no-gaussians", !data.frames.some((frame) => frame.found.some((found) => found.some((item) => item.g))));
  for (const [key, colour] of Object.entries(data.match_colours)) document.documentElement.style.setProperty(`--${key}`, colour);
  const [left, right, bottom, top] = data.extent;
  document.documentElement.style.setProperty("--aspect", (right - left) / (top - bottom));
  byId("curve-note").textContent = `AP in percent at each threshold${pair ? `: ${data.results.join(" (solid) | ")} (dashed)` : ""}.`;
  const [means, ...tables] = data.tables.map(table);
  if (means) byId("means").append(means);
  byId("tables").append(...tables);
  byId("curves").append(
    ...data.curves.map((panel) => curvePanel(panel, "recall", "precision")),
    ...data.reliability.map((panel) => {
      const figure = curvePanel(panel, "interval of the Gaussian", "errors within");
      figure.querySelector("svg").append(make("svg:path", { class: "axis", d: "M0 200L200 0" }));
      return figure;
    }));
  byId("shown").append(...data.results.map((name, r) => make("option", { value: r }, name)));
  const orders = { time: "as recorded", worst: "worst first", best: "best first" };
  if (pair) Object.assign(orders, { gain: `${data.results[0]} ahead first`, loss: `${data.results[1]} ahead first` });
  byId("order").append(...Object.entries(orders).map(([value, text]) => make("option", { value }, text)));
  byId("class").append(...data.classes.map((of, c) => make("option", { value: c }, of.title)));
  byId("scene").append(...[...new Set(data.frames.map((frame) => frame.scene))].map((name) => make("option", { value: name }, name)));
  for (const [id, kind, read] of [["class", "change", Number], ["scene", "change", String], ["token", "input", String]]) {
    byId(id).addEventListener(kind, (event) => {
      state[id] = read(event.target.value);
      sortCards();
      refresh();
    });
  }
  startZoom();
  byId("score").min = data.min_score;
  byId("score").value = state.score;
  byId("score").addEventListener("input", (event) => { state.score = Number(event.target.value); refresh(); });
  byId("score").addEventListener("change", sortCards);
  byId("order").addEventListener("change", sortCards);
  byId("shown").addEventListener("change", (event) => {
    state.shown = Number(event.target.value);
    drawCards();
    if (state.frame !== null) drawFrame();
    refresh();
  });
  byId("colour").addEventListener("change", (event) => {
    document.body.classList.toggle("by-match", event.target.value === "match");
    drawLegend();
  });
  for (const box of document.querySelectorAll("[data-layer]")) {
    box.addEventListener("change", () => {
      document.body.classList.toggle(`hide-${box.dataset.layer}`, !box.checked);
      opened.forEach(restyle);
    });
  }
  byId("previous").addEventListener("click", () => step(-1));
  byId("next").addEventListener("click", () => step(1));
  addEventListener("keydown", onKey);
  addEventListener("hashchange", route);
  drawLegend();
  drawCards();
  refresh();
  route();
}

start();
