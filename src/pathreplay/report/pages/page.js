// Interactive parts of a page about a run: wipe and zoom, exposure, curves, films, meshes, and live updates.
"use strict";

const SVG = document.getElementById("exposures").namespaceURI;
const byId = (id) => document.getElementById(id);
let run = JSON.parse(byId("data").textContent);

function make(tag, attributes = {}, ...children) {
  const svg = ["svg", "path", "line", "text", "circle", "rect", "filter", "feComponentTransfer", "feFuncR", "feFuncG", "feFuncB"];
  const node = svg.includes(tag) ? document.createElementNS(SVG, tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (value !== false && value !== null) node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children);
  return node;
}
const clamp = (x, low, high) => Math.min(high, Math.max(low, x));
const short = (x) => (x === null ? "unknown" : Math.abs(x) >= 1e5 || (x !== 0 && Math.abs(x) < 1e-3) ? x.toExponential(2) : String(+x.toPrecision(4)));

// ---------- Exposure: images are 8-bit sRGB, and a filter table maps each value to the value at another exposure ----------

const look = { stops: 0, own: new Set() };
const linear = (v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
const encoded = (x) => (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055);

function factorOf(view) {
  const { stored, own, name } = run.views[view];
  return ((look.own.has(name) ? own : run.exposure) / stored) * 2 ** look.stops;
}

// The CSS filter of a view; "" at the stored exposure.
function exposureOf(view) {
  const factor = factorOf(view), id = `exposure-${view}`;
  byId(id)?.remove();
  if (Math.abs(factor - 1) < 1e-6) return "";
  const values = Array.from({ length: 256 }, (_, i) => encoded(clamp(linear(i / 255) * factor, 0, 1)).toFixed(4)).join(" ");
  const channels = ["feFuncR", "feFuncG", "feFuncB"].map((tag) => make(tag, { type: "table", tableValues: values }));
  byId("exposures").append(make("filter", { id, "color-interpolation-filters": "sRGB", x: 0, y: 0, width: 1, height: 1 },
    make("feComponentTransfer", {}, ...channels)));
  return `url(#${id})`;
}

const sections = () => [...document.querySelectorAll("section.view")];
function expose() {
  sections().forEach((section, view) => {
    const filter = exposureOf(view);
    for (const image of section.querySelectorAll("img")) image.style.filter = filter;
  });
}

// ---------- The viewer: two images of a view with a movable border between them, and a zoom ----------

function viewer(place) {
  const state = { view: 0, left: run.left, right: run.right, wipe: 0.5, zoom: 1, x: 0, y: 0, still: -1 };
  const select = (label, change) => {
    const node = make("select", { onchange: () => { change(node.value); draw(); } });
    return [make("label", {}, label, node), node];
  };
  const [viewLabel, views] = select("view", (value) => { state.view = +value; state.still = -1; fit(); });
  const [leftLabel, left] = select("left", (value) => { state.left = value; });
  const [rightLabel, right] = select("right", (value) => { state.right = value; });
  const percent = make("output"), stops = make("output"), time = make("output");
  const brightness = make("input", { type: "range", min: -4, max: 6, step: 0.25, value: 0, "aria-label": "exposure in stops",
    oninput: () => { look.stops = +brightness.value; expose(); draw(); } });
  const own = make("input", { type: "checkbox", class: "own",
    onchange: () => { const name = run.views[state.view].name; if (own.checked) look.own.add(name); else look.own.delete(name); expose(); draw(); } });
  const under = make("img", { alt: "" }), over = make("img", { alt: "" });
  const layer = make("div", { class: "layer" }, over), edge = make("div", { class: "edge" });
  const a = make("span", { class: "name a" }), b = make("span", { class: "name b" });
  const stage = make("div", { class: "stage", tabindex: 0, role: "img" }, make("div", { class: "layer" }, under), layer, edge, a, b);
  const wipe = make("input", { type: "range", class: "wipe", min: 0, max: 1, step: 0.001, value: 0.5, "aria-label": "border between left and right",
    oninput: () => { state.wipe = +wipe.value; draw(); } });
  const film = make("input", { type: "range", min: 0, step: 1, "aria-label": "iteration", oninput: () => { state.still = +film.value; draw(); } });
  const filmLabel = make("label", {}, "iteration", film, time);
  const button = (text, title, action) => make("button", { type: "button", title, onclick: action }, text);

  function pictures() {
    const found = new Map();
    for (const image of sections()[state.view]?.querySelectorAll("img") ?? []) {
      found.set(image.dataset.kind, { src: image.src, caption: image.closest("figure").querySelector("figcaption").textContent });
    }
    const stills = run.views[state.view]?.film ?? [];
    if (stills.length) {
      const still = stills[state.still < 0 ? stills.length - 1 : clamp(state.still, 0, stills.length - 1)];
      found.set("through time", { src: still.src, caption: `after ${still.iteration} iterations` });
    }
    return found;
  }
  function options(node, names, chosen) {
    const text = JSON.stringify(names);
    if (node.dataset.names !== text) {
      node.replaceChildren(...names.map(([value, label]) => make("option", { value }, label)));
      node.dataset.names = text;
    }
    node.value = chosen;
  }
  function zoomTo(zoom, atX = 0.5, atY = 0.5) { // keep the point under the pointer fixed
    const next = clamp(zoom, 1, 32);
    state.x = atX - ((atX - state.x) / state.zoom) * next;
    state.y = atY - ((atY - state.y) / state.zoom) * next;
    state.zoom = next;
    draw();
  }
  function fit() { state.zoom = 1; state.x = state.y = 0; draw(); }
  function draw() {
    state.view = clamp(state.view, 0, run.views.length - 1);
    const found = pictures(), kinds = [...found.keys()];
    if (!kinds.length) { place.hidden = true; return; }
    place.hidden = false;
    if (!found.has(state.left)) state.left = kinds[0];
    if (!found.has(state.right)) state.right = kinds.find((kind) => kind !== state.left) ?? kinds[0];
    options(views, run.views.map((view, i) => [i, view.name.slice(0, 60)]), state.view);
    const labels = kinds.map((kind) => [kind, kind === "through time" ? kind : found.get(kind).caption]);
    options(left, labels, state.left);
    options(right, labels, state.right);
    for (const [image, kind] of [[under, state.left], [over, state.right]]) {
      if (image.getAttribute("src") !== found.get(kind).src) image.src = found.get(kind).src;
    }
    const filter = sections()[state.view].querySelector("img").style.filter;
    state.x = clamp(state.x, 1 - state.zoom, 0);
    state.y = clamp(state.y, 1 - state.zoom, 0);
    for (const image of [under, over]) {
      image.style.filter = filter;
      image.style.transform = `translate(${100 * state.x}%, ${100 * state.y}%) scale(${state.zoom})`;
    }
    layer.style.clipPath = `inset(0 0 0 ${100 * state.wipe}%)`;
    edge.style.left = `${100 * state.wipe}%`;
    wipe.value = state.wipe;
    stage.classList.toggle("zoomed", state.zoom > 1);
    stage.setAttribute("aria-label", `${run.views[state.view].name}: ${state.left} beside ${state.right}`);
    percent.textContent = `${Math.round(100 * state.zoom)} %`;
    stops.textContent = `${look.stops >= 0 ? "+" : ""}${look.stops} stops`;
    a.textContent = found.get(state.left).caption;
    b.textContent = found.get(state.right).caption;
    own.checked = look.own.has(run.views[state.view].name);
    const stills = run.views[state.view].film;
    filmLabel.hidden = !stills.length || ![state.left, state.right].includes("through time");
    film.max = stills.length - 1;
    const still = state.still < 0 ? stills.length - 1 : state.still;
    film.value = still;
    time.textContent = stills.length ? stills[clamp(still, 0, stills.length - 1)].iteration : "";
    size();
  }
  function size() {
    const { naturalWidth: w, naturalHeight: h } = under;
    if (!w) return;
    stage.style.aspectRatio = `${w} / ${h}`;
    stage.style.width = `min(100%, ${(70 * w) / h}vh)`;
  }
  under.addEventListener("load", size);

  const at = (event) => {
    const box = stage.getBoundingClientRect();
    return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  };
  let last = null;
  stage.addEventListener("pointerdown", (event) => { stage.setPointerCapture(event.pointerId); last = at(event); move(event); });
  function move(event) {
    if (!last) return;
    const [x, y] = at(event);
    if (state.zoom > 1) { state.x += x - last[0]; state.y += y - last[1]; } else state.wipe = clamp(x, 0, 1);
    last = [x, y];
    draw();
  }
  stage.addEventListener("pointermove", move);
  for (const name of ["pointerup", "pointercancel"]) stage.addEventListener(name, () => { last = null; });
  stage.addEventListener("dblclick", (event) => (state.zoom > 1 ? fit() : zoomTo(4, ...at(event))));
  stage.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !event.metaKey) return; // the page scrolls
    event.preventDefault();
    zoomTo(state.zoom * 2 ** (-event.deltaY / 200), ...at(event));
  }, { passive: false });
  stage.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -0.02, ArrowRight: 0.02 }[event.key];
    if (step) state.wipe = clamp(state.wipe + step, 0, 1);
    else if (event.key === "+" || event.key === "=") return zoomTo(state.zoom * 2);
    else if (event.key === "-") return zoomTo(state.zoom / 2);
    else return;
    event.preventDefault();
    draw();
  });
  byId("views").addEventListener("click", pick);
  function pick(event) {
    const image = event.target.closest?.("section.view img");
    if (!image) return;
    state.view = sections().indexOf(image.closest("section.view"));
    state.right = image.dataset.kind;
    if (state.left === state.right) state.left = run.left;
    draw();
    place.scrollIntoView({ block: "nearest", behavior: "smooth" });
  }

  place.append(
    make("div", { class: "tools" }, viewLabel, leftLabel, rightLabel, filmLabel),
    stage, wipe,
    make("div", { class: "tools" },
      make("span", {}, button("−", "zoom out", () => zoomTo(state.zoom / 2)), " ", percent, button("+", "zoom in", () => zoomTo(state.zoom * 2)), " ", button("fit", "all of it", fit)),
      make("label", {}, "exposure", brightness, stops),
      make("label", {}, own, "this view's own")));
  return { draw, renewed: () => byId("views").addEventListener("click", pick) };
}

// ---------- Curves ----------

function ticks(low, high, log) {
  if (log) {
    const from = Math.floor(Math.log10(low)), to = Math.ceil(Math.log10(high)), step = Math.ceil((to - from) / 5) || 1, found = [];
    for (let e = from; e <= to; e += step) found.push(10 ** e);
    const inside = found.filter((x) => x >= low && x <= high);
    return inside.length > 1 ? inside : [low, high];
  }
  const raw = (high - low || 1) / 4, unit = 10 ** Math.floor(Math.log10(raw));
  const step = unit * ([1, 2, 5].find((n) => n * unit >= raw) ?? 10), found = [];
  for (let x = Math.ceil(low / step) * step; x <= high + step * 1e-6; x += step) found.push(+x.toPrecision(12));
  return found;
}

function plot(spec, first) {
  const text = make("div", { class: "legend" }), holder = make("div");
  const title = make("figcaption", {}, spec.title, ...(spec.code ? [" ", make("code", {}, spec.code)] : []));
  const figure = make("figure", { class: first ? "plot first" : "plot" }, title, holder, text);
  const points = spec.series.map((series) => series.x.map((x, i) => [x, series.y[i]]).filter(([, y]) => y !== null));
  const all = points.flat();
  if (!all.length) { text.textContent = "no data yet"; return figure; }
  let [lowX, highX, lowY, highY] = all.reduce(([a, b, c, d], [x, y]) => [Math.min(a, x), Math.max(b, x), Math.min(c, y), Math.max(d, y)],
    [Infinity, -Infinity, Infinity, -Infinity]);
  const log = spec.log && lowY > 0;
  if (!log) { lowY = Math.min(lowY, 0); }
  if (highY === lowY) { highY = log ? lowY * 2 : lowY + 1; lowY = log ? lowY / 2 : lowY; }
  if (highX === lowX) highX = lowX + 1;

  function legend(at = null) {
    const parts = spec.series.map((series, s) => {
      const near = points[s].length && at !== null ? points[s].reduce((a, b) => (Math.abs(b[0] - at) < Math.abs(a[0] - at) ? b : a)) : null;
      const name = series.name ? `${series.name} ` : "";
      const value = near ? `${spec.series.length > 1 ? "" : `${spec.along} ${short(near[0])}: `}${short(near[1])}` : "";
      return name || value ? make("span", {}, ...(series.name ? [make("b", { class: `c${s % 8}` }, "● ")] : []), `${name}${value}  `) : "";
    });
    const where = at !== null && spec.series.length > 1 ? [`${spec.along} ${short(Math.round(at))}: `] : [];
    text.replaceChildren(...where, ...parts);
  }
  function draw() {
    const width = holder.clientWidth || 300, height = first ? 240 : 150, left = 58, right = 8, top = 6, bottom = 22;
    const X = (x) => left + ((x - lowX) / (highX - lowX)) * (width - left - right);
    const share = log ? (y) => Math.log(y / lowY) / Math.log(highY / lowY) : (y) => (y - lowY) / (highY - lowY);
    const Y = (y) => height - bottom - share(y) * (height - top - bottom);
    const svg = make("svg", { viewBox: `0 0 ${width} ${height}`, height, role: "img", "aria-label": `${spec.title} ${spec.code} by ${spec.along}` });
    for (const y of ticks(lowY, highY, log)) {
      svg.append(make("line", { class: "grid", x1: left, x2: width - right, y1: Y(y), y2: Y(y) }),
        make("text", { x: left - 6, y: Y(y) + 4, "text-anchor": "end" }, short(y)));
    }
    for (const x of ticks(lowX, highX, false)) svg.append(make("text", { x: X(x), y: height - 6, "text-anchor": "middle" }, String(x)));
    points.forEach((line, s) => {
      if (line.length === 1) svg.append(make("circle", { class: `c${s % 8}`, cx: X(line[0][0]), cy: Y(line[0][1]), r: 2, fill: "currentColor" }));
      const d = line.map(([x, y], i) => `${i ? "L" : "M"}${X(x).toFixed(1)} ${Y(y).toFixed(1)}`).join("");
      svg.append(make("path", { class: `line c${s % 8}`, d }));
    });
    const hair = make("line", { class: "hair", y1: top, y2: height - bottom, visibility: "hidden" });
    svg.append(hair);
    svg.addEventListener("pointermove", (event) => {
      const box = svg.getBoundingClientRect();
      const x = clamp(lowX + ((((event.clientX - box.left) / box.width) * width - left) / (width - left - right)) * (highX - lowX), lowX, highX);
      for (const end of ["x1", "x2"]) hair.setAttribute(end, X(x));
      hair.setAttribute("visibility", "visible");
      legend(x);
    });
    svg.addEventListener("pointerleave", () => { hair.setAttribute("visibility", "hidden"); legend(); });
    holder.replaceChildren(svg);
    legend();
  }
  new ResizeObserver(draw).observe(holder);
  return figure;
}

function plots() {
  const drawn = run.plots.map((spec, i) => plot(spec, i === 0));
  byId("plots").replaceChildren(make("div", { class: "plots" }, ...drawn));
}

// ---------- Films of textures and volumes ----------

function film(place, stills) {
  const image = make("img", { alt: "through time" }), label = make("output");
  let timer = 0, all = stills;
  const range = make("input", { type: "range", min: 0, max: all.length - 1, step: 1, value: all.length - 1, "aria-label": "iteration", oninput: () => { show(); } });
  const play = make("button", { type: "button", onclick: () => {
    if (timer) { clearInterval(timer); timer = 0; play.textContent = "play"; return; }
    play.textContent = "pause";
    timer = setInterval(() => { range.value = (+range.value + 1) % all.length; show(); }, 120);
  } }, "play");
  function show() {
    const still = all[clamp(+range.value, 0, all.length - 1)];
    if (image.getAttribute("src") !== still.src) image.src = still.src;
    label.textContent = `after ${still.iteration} iterations`;
  }
  place.append(make("div", { class: "film" }, make("div", { class: "tools" }, play, range, label), image));
  show();
  return (next) => { const end = +range.value >= all.length - 1; all = next; range.max = all.length - 1; if (end) range.value = all.length - 1; show(); };
}

const films = [];
function extras() {
  const places = document.querySelectorAll("section.parameter .extra");
  run.parameters.forEach((parameter, i) => {
    if (films[i]) films[i](parameter.film);
    else if (parameter.film.length > 1) films[i] = film(places[i], parameter.film);
    if (parameter.mesh && !places[i].querySelector(".mesh")) mesh(places[i], parameter.mesh);
  });
}

// ---------- Meshes: triangles lit from the viewpoint, rotated by dragging ----------

const VERTEX = `attribute vec3 place, normal; uniform mat3 turn; uniform vec3 middle; uniform float scale; varying vec3 n;
void main() { n = turn * normal; vec3 p = turn * (place - middle) * scale; gl_Position = vec4(0.75 * p.x, p.y, -0.01 * p.z, 1.0); }`;
const FRAGMENT = `precision mediump float; varying vec3 n; uniform vec3 paint;
void main() { vec3 m = normalize(n); gl_FragColor = vec4(paint * (0.25 + 0.75 * abs(m.z)) * (m.z < 0.0 ? 0.5 : 1.0), 1.0); }`;

function numbers(text, Kind) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  return new Kind(bytes.buffer);
}

function mesh(place, data) {
  const canvas = make("canvas", { class: "mesh", width: 800, height: 600, tabindex: 0, role: "img", "aria-label": "mesh; drag to turn it" });
  const kinds = Object.keys(data.vertices);
  const choice = make("select", { onchange: () => { fill(); draw(); } }, ...kinds.map((kind) => make("option", { value: kind }, kind)));
  choice.value = kinds.includes("result") ? "result" : kinds[0];
  place.append(make("div", { class: "tools" }, make("label", {}, "mesh", choice), "drag turns it, the wheel with Ctrl zooms"), canvas);
  const gl = canvas.getContext("webgl", { antialias: true });
  if (!gl) return canvas.replaceWith(make("p", { class: "soft" }, "This browser shows no WebGL, and so no mesh."));
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  gl.useProgram(program);
  gl.enable(gl.DEPTH_TEST);
  const faces = numbers(data.faces, Uint32Array);
  const bounds = kinds.map((kind) => numbers(data.vertices[kind], Float32Array)).reduce(([low, high], all) => {
    all.forEach((x, i) => { low[i % 3] = Math.min(low[i % 3], x); high[i % 3] = Math.max(high[i % 3], x); });
    return [low, high];
  }, [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]]);
  const middle = [0, 1, 2].map((k) => (bounds[0][k] + bounds[1][k]) / 2);
  const extent = Math.hypot(...[0, 1, 2].map((k) => bounds[1][k] - bounds[0][k])) || 1;
  let around = 0.6, up = 0.4, zoom = 1;

  function fill() { // unshared vertices, each with the normal of its face
    const all = numbers(data.vertices[choice.value], Float32Array), places = new Float32Array(3 * faces.length), normals = new Float32Array(3 * faces.length);
    for (let f = 0; f < faces.length; f += 3) {
      const [a, b, c] = [0, 1, 2].map((k) => all.subarray(3 * faces[f + k], 3 * faces[f + k] + 3));
      const u = [0, 1, 2].map((k) => b[k] - a[k]), v = [0, 1, 2].map((k) => c[k] - a[k]);
      const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]], length = Math.hypot(...n) || 1;
      [a, b, c].forEach((p, k) => { places.set(p, 3 * (f + k)); normals.set(n.map((x) => x / length), 3 * (f + k)); });
    }
    [["place", places], ["normal", normals]].forEach(([name, values]) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
      const at = gl.getAttribLocation(program, name);
      gl.enableVertexAttribArray(at);
      gl.vertexAttribPointer(at, 3, gl.FLOAT, false, 0, 0);
    });
  }
  function draw() {
    const [ca, sa, cu, su] = [Math.cos(around), Math.sin(around), Math.cos(up), Math.sin(up)];
    const uniform = (name) => gl.getUniformLocation(program, name);
    // Columns of the rotation about y, then about x; the view direction is -z.
    gl.uniformMatrix3fv(uniform("turn"), false, [ca, su * sa, -cu * sa, 0, cu, su, sa, -su * ca, cu * ca]);
    gl.uniform3fv(uniform("middle"), middle);
    gl.uniform1f(uniform("scale"), (1.8 * zoom) / extent);
    gl.uniform3f(uniform("paint"), 0.55, 0.68, 0.85);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.drawArrays(gl.TRIANGLES, 0, faces.length);
  }
  let last = null;
  canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); last = [event.clientX, event.clientY]; });
  canvas.addEventListener("pointermove", (event) => {
    if (!last) return;
    around += (event.clientX - last[0]) / 150;
    up = clamp(up + (event.clientY - last[1]) / 150, -1.5, 1.5);
    last = [event.clientX, event.clientY];
    draw();
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => { last = null; });
  canvas.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !event.metaKey) return;
    event.preventDefault();
    zoom = clamp(zoom * 2 ** (-event.deltaY / 200), 0.2, 50);
    draw();
  }, { passive: false });
  fill();
  draw();
}

// ---------- Live updates of an active run ----------

async function news() {
  const alive = byId("alive");
  try {
    const answer = await fetch("./", { cache: "no-store" });
    if (!answer.ok) throw new Error(`server status ${answer.status}`);
    const fresh = new DOMParser().parseFromString(await answer.text(), "text/html");
    const same = fresh.documentElement.hasAttribute("data-live") && fresh.querySelectorAll("[data-part]").length === document.querySelectorAll("[data-part]").length;
    if (!same) return location.reload(); // the run has ended, and the server sends its report
    for (const part of fresh.querySelectorAll("[data-part]")) {
      const old = byId(part.id);
      if (old.outerHTML !== part.outerHTML) old.replaceWith(part);
    }
    run = JSON.parse(fresh.getElementById("data").textContent);
    refresh();
    alive.textContent = "following";
  } catch (error) {
    alive.textContent = `no updates (${error.message}): is pathreplay watch still running?`;
  }
  setTimeout(news, 2000);
}

async function stop() {
  byId("stop").disabled = true;
  try {
    const answer = await fetch("stop", { method: "POST" });
    byId("stop").textContent = answer.ok ? "Stopping after this iteration" : await answer.text();
  } catch (error) {
    byId("stop").disabled = false;
    byId("alive").textContent = `the run was not stopped (${error.message})`;
  }
}

const stage = byId("viewer") && run.views.length ? viewer(byId("viewer")) : null;
function refresh() {
  if (stage) { stage.renewed(); expose(); stage.draw(); }
  plots();
  extras();
}
if (stage) { expose(); stage.draw(); }
plots();
extras();
document.documentElement.classList.add("ready");
if (run.live) {
  byId("stop").addEventListener("click", stop);
  setTimeout(news, 2000);
}
