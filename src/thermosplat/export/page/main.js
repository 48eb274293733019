// The page itself: what is chosen, what is drawn when, and what the pointer reads.
const byId = (id) => document.getElementById(id);
const settings = { tool: "read", scale: 1, wipe: 0.5, share: 0.5 };
const LEAST_COVER = 0.02; // of a pixel whose value is told: Gaussians of temperatures are thin

function say(text) {
  byId("message").textContent = text;
  byId("message").hidden = !text;
}

function filled(select, names, chosen = 0) {
  select.replaceChildren(...names.map((name, k) => Object.assign(document.createElement("option"), { value: k, textContent: name })));
  select.value = chosen;
}

async function start() {
  const scene = JSON.parse(textOf("scene")), canvas = byId("picture"), renderer = new Renderer(canvas);
  canvas.addEventListener("webglcontextlost", () => say("The graphics card took the picture away. Reload the page."));
  byId("title").textContent = scene.title;
  const layers = [];
  for (const [k, layer] of scene.layers.entries())
    layers.push({ ...layer, set: renderer.add(splatsOf(layer.splats, await unzipped(textOf(`splats${k}`)))) });
  const camera = new Camera(scene.up, scene.spacing), marks = new Marks(scene, JSON.parse(textOf("marks")));
  const valued = layers.filter((layer) => layer.set.channels === 1);
  const first = () => layers[byId("first").value], second = () => layers[byId("second").value];
  const measured = () => [first(), second(), ...valued].find((layer) => layer.set.channels === 1);
  const ratio = () => Math.min(window.devicePixelRatio || 1, 2);

  // ---- drawing: fewer pixels while it moves on a slow machine, all of them at rest
  let asked = false, resting = 0, before = 0, fixed = null;
  const seen = () => {
    if (fixed) return camera.seen(...fixed);
    const factor = ratio() * settings.scale;
    return camera.seen(Math.max(2, Math.round(canvas.clientWidth * factor)), Math.max(2, Math.round(canvas.clientHeight * factor)));
  };
  const draw = () => {
    asked = false;
    const view = seen(), [width, height] = view.size, mode = byId("mode").value;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const pair = [first(), mode === "alone" ? first() : second()];
    for (const layer of new Set(pair)) renderer.draw(layer.set, view);
    const scaled = (layer, value) => (value - layer.range[0]) / (layer.range[1] - layer.range[0]);
    const shown = pair.map((layer) => ({ set: layer.set, back: layer.back,
      span: layer.set.channels === 1 ? [scaled(layer, layer.shown[0]), scaled(layer, layer.shown[1])] : [0, 1] }));
    const limit = (id, none) => (byId(id).value === "" || !measured() ? none : scaled(measured(), Number(byId(id).value)));
    const band = [limit("from", -1e9), limit("to", 1e9), byId("isotherm").checked ? 1 : 0];
    renderer.show(...shown, { wipe: mode === "wipe" ? settings.wipe : -1, share: { alone: 0, wipe: 1, blend: settings.share }[mode], band });
    const over = byId("marked"), full = ratio();
    const size = [Math.round(over.clientWidth * full), Math.round(over.clientHeight * full)];
    if (over.width !== size[0] || over.height !== size[1]) [over.width, over.height] = size;
    marks.draw(over.getContext("2d"), camera.seen(...size), full);
  };
  const ask = () => {
    if (!asked) requestAnimationFrame(draw);
    asked = true;
  };
  const moved = () => {
    const now = performance.now(), passed = now - before;
    before = now;
    if (asked && passed < 400) { /* the last one is not drawn yet */ }
    else if (passed < 400) settings.scale = Math.min(1, Math.max(0.25, settings.scale * (passed > 90 ? 0.8 : passed < 35 ? 1.1 : 1)));
    clearTimeout(resting);
    resting = setTimeout(() => { settings.scale = 1; ask(); }, 200);
    byId("value").hidden = true;
    ask();
  };

  // ---- reading: the picture of values at rest
  const picture = () => {
    settings.scale = 1;
    const view = seen(), layer = measured(), [width, height] = view.size;
    renderer.draw(layer.set, view);
    const share = (four) => four[0] + (1 - four[3]) * layer.back[0];
    const value = (four) => (four[3] >= LEAST_COVER ? layer.range[0] + share(four) * (layer.range[1] - layer.range[0]) : null);
    const within = (x, y) => x >= 0 && y >= 0 && x < width && y < height;
    let all = null;
    return {
      width, height, camera: view, layer,
      here: (x, y) => (within(x, y) ? value(renderer.read(layer.set, Math.floor(x), Math.floor(y), 1, 1)) : null),
      value: (x, y) => {
        all ??= renderer.read(layer.set, 0, 0, width, height);
        return within(x, y) ? value(all.subarray(4 * (y * width + x))) : null;
      },
      // The opaque splats say where the surface is: those of photographs, where there are any.
      point: (x, y) => {
        const { set } = layers.find((one) => one.set.channels === 3) ?? layer;
        renderer.draw(set, view, true);
        const four = within(x, y) ? renderer.read(set, Math.floor(x), Math.floor(y), 1, 1) : [0, 0, 0, 0];
        return four[3] >= LEAST_COVER ? lifted(x, y, four[0] / four[3], view) : null;
      },
    };
  };
  const place = ({ x, y }, { width, height }) => [(x / canvas.clientWidth) * width, (y / canvas.clientHeight) * height];
  const hovered = (at) => {
    const box = byId("value");
    if (!at || !measured()) return (box.hidden = true);
    const now = picture(), found = now.here(...place(at, now));
    box.hidden = found === null;
    if (found === null) return;
    box.textContent = marks.withUnit(found, now.layer);
    box.style.left = `${Math.min(at.x + 14, canvas.clientWidth - box.offsetWidth - 6)}px`;
    box.style.top = `${Math.min(at.y + 14, canvas.clientHeight - box.offsetHeight - 6)}px`;
  };
  const finish = (kind) => {
    const mark = marks.made(kind, marks.open, picture());
    if (kind === "note") mark.text = (byId("note").value.trim() || "note").slice(0, 1000);
    marks.open = [];
    marks.all.push(mark);
    listed();
  };
  const clicked = (at) => {
    const kind = settings.tool;
    if (kind === "read" || !measured()) return hovered(at);
    const now = picture(), point = now.point(...place(at, now));
    if (!point) return say("Nothing is there, or too little of it.");
    say("");
    marks.open.push(point);
    const enough = { spot: 1, note: 1, line: 2 }[kind];
    if (enough === marks.open.length) finish(kind);
    byId("finish").hidden = !(kind === "area" && marks.open.length > 2);
    ask();
  };
  const listed = () => {
    byId("list").replaceChildren(...marks.all.map((mark, k) => {
      const row = document.createElement("li"), go = document.createElement("button"), away = document.createElement("button");
      Object.assign(go, { textContent: `${mark.name}  ${mark.text}`, className: "mark", title: "Look at it" });
      Object.assign(away, { textContent: "×", className: "away", title: "Delete", ariaLabel: `Delete ${mark.name}` });
      go.addEventListener("click", () => { camera.lookAt(mark.points[0]); moved(); });
      away.addEventListener("click", () => { marks.all.splice(k, 1); listed(); ask(); });
      row.append(go, away);
      return row;
    }));
  };

  // ---- controls
  const names = layers.map((layer) => layer.name), ordered = Math.max(0, layers.indexOf(valued[0]));
  filled(byId("first"), names, ordered);
  filled(byId("second"), names, layers.findIndex((_, k) => k !== ordered) >= 0 ? layers.findIndex((_, k) => k !== ordered) : 0);
  filled(byId("palette"), scene.palettes.map(({ name }) => name));
  filled(byId("views"), scene.views.map(({ name }) => name), scene.start);
  const palette = () => scene.palettes[byId("palette").value].colors.match(/../g).map((pair) => parseInt(pair, 16));
  const colored = () => {
    const levels = palette(), bytes = new Uint8Array(1024), bar = byId("bar").getContext("2d");
    for (let k = 0; k < 256; k++) bytes.set([...levels.slice(3 * k, 3 * k + 3), 255], 4 * k);
    renderer.setPalette(bytes);
    const image = bar.createImageData(1, 256);
    for (let k = 0; k < 256; k++) image.data.set(bytes.subarray(4 * k, 4 * k + 4), 4 * (255 - k));
    bar.putImageData(image, 0, 0);
    ask();
  };
  const ranged = () => {
    const layer = measured(), mode = byId("mode").value, shows = layer && (mode === "alone" ? [first()] : [first(), second()]).includes(layer);
    byId("legend").hidden = !shows;
    for (const part of document.querySelectorAll(".values")) part.hidden = !layer;
    for (const part of document.querySelectorAll(".pair")) part.hidden = mode === "alone";
    byId("wipe").hidden = mode !== "wipe";
    byId("wipe").style.left = `${100 * settings.wipe}%`;
    byId("slider").value = 100 * (mode === "wipe" ? settings.wipe : settings.share);
    if (layer) {
      [byId("low").value, byId("high").value] = layer.shown.map((end) => Number(end.toFixed(layer.decimals)));
      [byId("least").textContent, byId("most").textContent] = layer.shown.map((end) => marks.withUnit(end, layer));
    }
    ask();
  };
  const on = (id, event, done) => byId(id).addEventListener(event, done);
  for (const id of ["first", "second", "mode"]) on(id, "change", ranged);
  on("palette", "change", colored);
  on("slider", "input", (event) => {
    settings[byId("mode").value === "wipe" ? "wipe" : "share"] = event.target.value / 100;
    ranged();
  });
  on("wipe", "pointerdown", (event) => event.target.setPointerCapture(event.pointerId));
  on("wipe", "pointermove", (event) => {
    if (!event.buttons) return;
    settings.wipe = Math.min(1, Math.max(0, event.clientX / canvas.clientWidth));
    ranged();
  });
  for (const id of ["low", "high"]) on(id, "change", () => {
    const ends = [Number(byId("low").value), Number(byId("high").value)];
    if (ends.every(Number.isFinite) && ends[0] < ends[1]) measured().shown = ends;
    ranged();
  });
  on("auto", "click", () => {
    const now = picture(), all = [];
    for (let y = 0; y < now.height; y += 3) for (let x = 0; x < now.width; x += 3) all.push(now.value(x, y));
    const sorted = all.filter((value) => value !== null).sort((a, b) => a - b);
    const [low, high] = [sorted[Math.floor(0.01 * sorted.length)], sorted[Math.floor(0.99 * sorted.length)]];
    if (low < high) measured().shown = [low, high];
    ranged();
  });
  for (const id of ["from", "to", "isotherm"]) on(id, "input", ask);
  on("views", "change", () => { camera.look(scene.views[byId("views").value], scene.focus); moved(); });
  on("fly", "change", (event) => (camera.mode = event.target.checked ? "fly" : "orbit"));
  for (const button of document.querySelectorAll("[data-tool]")) button.addEventListener("click", () => {
    settings.tool = button.dataset.tool;
    marks.open = [];
    byId("finish").hidden = true;
    byId("note").hidden = settings.tool !== "note";
    for (const other of document.querySelectorAll("[data-tool]")) other.setAttribute("aria-pressed", other === button);
    ask();
  });
  on("finish", "click", () => { finish("area"); byId("finish").hidden = true; ask(); });
  window.addEventListener("keydown", (event) => {
    if (event.key !== "Escape") return;
    marks.open = [];
    byId("finish").hidden = true;
    ask();
  });
  const saved = (content, type, name) => {
    const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(new Blob([content], { type })), download: name });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  };
  on("csv", "click", () => saved(marks.csv(scene.origin), "text/csv", "measurements.csv"));
  on("save", "click", () => {
    const copy = document.documentElement.cloneNode(true);
    copy.querySelector("#marks").textContent = JSON.stringify(marks.all).replaceAll("<", "\\u003c");
    for (const part of copy.querySelectorAll("[style]")) part.removeAttribute("style");
    copy.querySelector("#list").replaceChildren();
    saved(`<!doctype html>\n${copy.outerHTML}`, "text/html", "scene.html");
  });
  on("fold", "click", () => {
    const folded = byId("panel").classList.toggle("folded");
    byId("fold").setAttribute("aria-expanded", !folded);
  });
  if (window.innerWidth < 700) byId("panel").classList.add("folded");
  camera.look(scene.views[scene.start], scene.focus);
  steer(canvas, camera, { moved, clicked, hovered });
  new ResizeObserver(ask).observe(canvas);
  listed();
  colored();
  ranged();
  draw();
  say("");
  document.documentElement.dataset.ready = "1";
  // for scripts and tests: stand exactly somewhere, read what is drawn
  window.thermosplat = {
    camera, marks, draw, layers,
    look(viewmat, focal, middle, size) {
      camera.look({ viewmat, fov: 50 }, scene.focus);
      camera.intrinsics = { focal, middle };
      fixed = size;
      settings.scale = 1;
      draw();
    },
    blended(name) {
      const { set } = layers.find((layer) => layer.key === name), view = seen();
      renderer.draw(set, view);
      return Array.from(renderer.read(set, 0, 0, ...view.size));
    },
    values() {
      const now = picture();
      return Array.from({ length: now.width * now.height }, (_, k) => now.value(k % now.width, Math.floor(k / now.width)));
    },
    here: (x, y) => picture().here(x, y),
  };
}

start().catch((error) => say(`${error.message ?? error}`));
