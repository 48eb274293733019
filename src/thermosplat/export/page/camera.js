// A camera that turns about a point (orbit) or on the spot (fly). Rows of `turn` are right, down and forward (OpenCV).
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const plus = (a, b, times = 1) => [a[0] + times * b[0], a[1] + times * b[1], a[2] + times * b[2]];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const scaled = (a, to = 1) => plus([0, 0, 0], a, to / (Math.hypot(...a) || 1));

function turnedAbout(v, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle);
  return plus(plus(plus([0, 0, 0], v, c), cross(axis, v), s), axis, dot(axis, v) * (1 - c));
}

class Camera {
  constructor(up, spacing) {
    Object.assign(this, { up, spacing, mode: "orbit", intrinsics: null });
  }

  // Stand where a view of the capture was taken, and look at what is `focus` away.
  look({ viewmat, fov }, focus) {
    this.rows = [0, 1, 2].map((k) => viewmat[k].slice(0, 3));
    const shift = viewmat.map((row) => row[3]);
    this.eye = [0, 1, 2].map((k) => -dot(this.rows.map((row) => row[k]), shift));
    this.fov = fov;
    this.reach = Math.max(dot(plus(focus, this.eye, -1), this.rows[2]), this.spacing);
    this.intrinsics = null;
  }

  get target() { return plus(this.eye, this.rows[2], this.reach); }

  lookAt(point) {
    this.eye = plus(this.eye, plus(point, this.target, -1));
    this.intrinsics = null;
  }

  rotate(x, y) {
    const target = this.target, fixed = this.mode === "orbit";
    const sign = fixed ? 1 : -1, right = this.rows[0];
    const axis = Math.abs(dot(this.up, this.rows[2])) > 0.98 ? scaled(this.rows[1], -1) : this.up;
    this.rows = this.rows.map((row) => turnedAbout(turnedAbout(row, right, -sign * y), axis, -sign * x));
    this.rows[2] = scaled(this.rows[2]);
    this.rows[0] = scaled(cross(this.rows[1], this.rows[2]));
    this.rows[1] = cross(this.rows[2], this.rows[0]);
    if (fixed) this.eye = plus(target, this.rows[2], -this.reach);
    this.intrinsics = null;
  }

  move(right, down, forward) {
    const [r, d, f] = this.rows;
    this.eye = plus(plus(plus(this.eye, r, right), d, down), f, forward);
    this.intrinsics = null;
  }

  zoom(factor) {
    if (this.mode === "fly") return this.move(0, 0, (1 - factor) * this.reach);
    const target = this.target;
    this.reach = Math.min(Math.max(this.reach * factor, 0.02 * this.spacing), 1e6 * this.spacing);
    this.eye = plus(target, this.rows[2], -this.reach);
    this.intrinsics = null;
  }

  // What the renderer needs, for a picture of some pixels.
  seen(width, height) {
    const focal = height / (2 * Math.tan((this.fov * Math.PI) / 360));
    const own = this.intrinsics ?? { focal: [focal, focal], middle: [width / 2, height / 2] };
    const shift = this.rows.map((row) => -dot(row, this.eye));
    return { turn: this.rows.flat(), shift, ...own, size: [width, height] };
  }
}

// Where a point of the scene is in a picture [px], and how far away; null behind the camera.
function projected(point, { turn, shift, focal, middle }) {
  const [x, y, z] = [0, 1, 2].map((k) => dot(turn.slice(3 * k, 3 * k + 3), point) + shift[k]);
  return z > 0.01 ? [(focal[0] * x) / z + middle[0], (focal[1] * y) / z + middle[1], z] : null;
}

// The point of the scene at a place of a picture [px] and a depth.
function lifted(x, y, depth, { turn, shift, focal, middle }) {
  const p = [((x - middle[0]) / focal[0]) * depth, ((y - middle[1]) / focal[1]) * depth, depth];
  const q = plus(p, shift, -1);
  return [0, 1, 2].map((k) => turn[k] * q[0] + turn[3 + k] * q[1] + turn[6 + k] * q[2]);
}

// Fingers, mouse and keys. `moved` is called after each change, `clicked` with a place where nothing was dragged.
function steer(element, camera, { moved, clicked, hovered }) {
  const pointers = new Map(), keys = new Set();
  let start = null, dragged = false;
  const spread = () => {
    const [a, b] = [...pointers.values()];
    return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, apart: Math.hypot(a.x - b.x, a.y - b.y) };
  };
  const slide = (dx, dy) => {
    const step = (2 * camera.reach * Math.tan((camera.fov * Math.PI) / 360)) / element.clientHeight;
    camera.move(-dx * step, -dy * step, 0);
  };
  element.addEventListener("pointerdown", (event) => {
    element.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.offsetX, y: event.offsetY });
    if (pointers.size === 1) [start, dragged] = [{ x: event.offsetX, y: event.offsetY }, false];
    else dragged = true;
  });
  element.addEventListener("pointermove", (event) => {
    const held = pointers.get(event.pointerId), now = { x: event.offsetX, y: event.offsetY };
    if (!held) return hovered(now);
    if (!dragged && Math.hypot(now.x - start.x, now.y - start.y) < 5) return;
    dragged = true;
    if (pointers.size === 2) {
      const before = spread();
      pointers.set(event.pointerId, now);
      const after = spread();
      if (after.apart > 0) camera.zoom(before.apart / after.apart);
      slide(after.x - before.x, after.y - before.y);
    } else {
      pointers.set(event.pointerId, now);
      const [dx, dy] = [now.x - held.x, now.y - held.y];
      if (event.buttons === 2 || event.shiftKey) slide(dx, dy);
      else camera.rotate((3 * dx) / element.clientHeight, (3 * dy) / element.clientHeight);
    }
    moved();
  });
  const up = (event) => {
    if (!pointers.delete(event.pointerId)) return;
    if (event.type === "pointerup" && !dragged) clicked({ x: event.offsetX, y: event.offsetY });
  };
  element.addEventListener("pointerup", up);
  element.addEventListener("pointercancel", up);
  element.addEventListener("pointerleave", (event) => event.pointerType === "mouse" && hovered(null));
  element.addEventListener("contextmenu", (event) => event.preventDefault());
  element.addEventListener("wheel", (event) => {
    event.preventDefault();
    camera.zoom(Math.exp(0.001 * Math.max(-300, Math.min(300, event.deltaY))));
    moved();
  }, { passive: false });
  const ways = { w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, 1, 0], e: [0, -1, 0],
    arrowup: [0, 0, 1], arrowdown: [0, 0, -1], arrowleft: [-1, 0, 0], arrowright: [1, 0, 0] };
  let last = 0;
  const fly = (time) => {
    if (!keys.size) return;
    const seconds = Math.min(0.2, (time - last) / 1000), step = seconds * camera.spacing * 3;
    last = time;
    for (const key of keys) camera.move(...ways[key].map((way) => way * step));
    moved();
    requestAnimationFrame(fly);
  };
  window.addEventListener("keydown", (event) => {
    const key = event.key.toLowerCase();
    if (!ways[key] || event.ctrlKey || event.metaKey || /INPUT|SELECT|TEXTAREA/.test(event.target.tagName)) return;
    event.preventDefault();
    if (keys.add(key).size === 1 && !event.repeat) requestAnimationFrame((time) => fly((last = time)));
  });
  window.addEventListener("keyup", (event) => keys.delete(event.key.toLowerCase()));
  window.addEventListener("blur", () => keys.clear());
}
