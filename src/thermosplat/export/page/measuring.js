// What is measured on the page: spots, lines, areas and notes, anchored on points of the scene, drawn over the picture.
class Marks {
  constructor(scene, list) {
    this.scene = scene;
    this.all = list;
    this.open = [];
  }

  withUnit(value, { decimals, unit }) { return `${value.toFixed(decimals)} ${unit}`.trim(); }

  extent(length, power = 1) {
    const metres = this.scene.metres, size = length * (metres ?? 1) ** power;
    return `${Number(size.toPrecision(3))} ${metres ? "m" : "units"}${power === 2 ? "²" : ""}`;
  }

  name(kind) {
    const letter = { spot: "S", line: "L", area: "A", note: "N" }[kind], taken = new Set(this.all.map((one) => one.name));
    let k = 1;
    while (taken.has(letter + k)) k++;
    return letter + k;
  }

  // A mark on points of the scene, with what a picture has between them.
  made(kind, points, picture) {
    const places = points.map((point) => projected(point, picture.camera)).filter((place) => place).map(([x, y]) => ({ x, y }));
    const mark = { kind, name: this.name(kind), points, text: "" };
    const pixels = places.length < points.length ? [] : PIXELS[kind](places, picture);
    const values = pixels.map(([x, y]) => picture.value(x, y)).filter((value) => value !== null);
    if (values.length) {
      const sum = values.reduce((a, b) => a + b, 0);
      Object.assign(mark, { mean: sum / values.length, minimum: values.reduce((a, b) => Math.min(a, b)),
        maximum: values.reduce((a, b) => Math.max(a, b)) });
      const [mean, minimum, maximum] = [mark.mean, mark.minimum, mark.maximum].map((one) => this.withUnit(one, picture.layer));
      mark.text = kind === "spot" ? mean : `${mean} (${minimum} to ${maximum})`;
    }
    if (kind === "line") mark.length = Math.hypot(...plus(points[1], points[0], -1));
    if (kind === "area") {
      const corners = points.map((point) => plus(point, points[0], -1));
      const sum = corners.reduce((a, corner, k) => plus(a, cross(corner, corners[(k + 1) % corners.length])), [0, 0, 0]);
      mark.surface = Math.hypot(...sum) / 2;
    }
    if (mark.length !== undefined) mark.text = `${this.extent(mark.length)}, ${mark.text}`;
    if (mark.surface !== undefined) mark.text = `${this.extent(mark.surface, 2)}, ${mark.text}`;
    return mark;
  }

  draw(context, camera, ratio) {
    const { width, height } = context.canvas;
    context.clearRect(0, 0, width, height);
    context.font = `600 ${12 * ratio}px system-ui, sans-serif`;
    context.lineWidth = 2 * ratio;
    context.textBaseline = "middle";
    for (const mark of this.all) this.one(context, camera, ratio, mark, mark.kind === "finding" ? "#ff5a5a" : "#ffffff");
    if (this.open.length) this.one(context, camera, ratio, { kind: "line", points: this.open, name: "" }, "#35f35a");
  }

  one(context, camera, ratio, { kind, points, name }, color) {
    const at = points.map((point) => projected(point, camera)).filter((place) => place);
    if (at.length < points.length || !at.length) return;
    const stroke = (style, width) => {
      context.strokeStyle = style;
      context.lineWidth = width * ratio;
      context.stroke();
    };
    context.beginPath();
    at.forEach(([x, y], k) => (k ? context.lineTo(x, y) : context.moveTo(x, y)));
    if (kind === "area") context.closePath();
    stroke("rgba(0,0,0,.7)", 4);
    stroke(color, 2);
    for (const [x, y] of at) {
      context.beginPath();
      context.arc(x, y, (kind === "finding" ? 6 : 4) * ratio, 0, 7);
      context.fillStyle = color;
      context.fill();
      stroke("rgba(0,0,0,.8)", 1.5);
    }
    const shown = name.length > 24 ? `${name.slice(0, 23)}…` : name, [x, y] = at[0], wide = context.measureText(shown).width;
    if (!shown) return;
    context.fillStyle = "rgba(16,18,24,.75)";
    context.fillRect(x + 9 * ratio, y - 9 * ratio, wide + 8 * ratio, 18 * ratio);
    context.fillStyle = "#fff";
    context.fillText(shown, x + 13 * ratio, y);
  }

  // A table for programs: one row per mark, places in the world of the capture. No cell begins as a formula would.
  csv(origin) {
    const cell = (text) => `"${String(text ?? "").replace(/^[=+@\t\r-]/, "'$&").replaceAll('"', '""')}"`;
    const digits = (value) => (value === undefined ? "" : Number(value.toPrecision(7)));
    const rows = this.all.map((one) => [cell(one.name), one.kind, digits(one.mean), digits(one.minimum), digits(one.maximum),
      digits(one.length), digits(one.surface), ...plus(one.points[0], origin).map(digits), cell(one.text)]);
    return ["name,kind,mean,minimum,maximum,length,area,x,y,z,text", ...rows.map((row) => row.join(","))].join("\n");
  }
}

const PIXELS = { spot: ([{ x, y }]) => [[Math.floor(x), Math.floor(y)]], line: linePixels, area: areaPixels, note: () => [] };

function linePixels([from, to]) {
  const count = Math.ceil(Math.max(Math.abs(to.x - from.x), Math.abs(to.y - from.y))) + 1;
  const share = (k) => k / Math.max(count - 1, 1);
  return Array.from({ length: count }, (_, k) => [Math.floor(from.x + share(k) * (to.x - from.x)),
    Math.floor(from.y + share(k) * (to.y - from.y))]);
}

function areaPixels(corners, { width, height }) {
  const pixels = [], xs = corners.map(({ x }) => x), ys = corners.map(({ y }) => y);
  for (let y = Math.max(0, Math.floor(Math.min(...ys))); y < Math.min(height, Math.max(...ys)); y++)
    for (let x = Math.max(0, Math.floor(Math.min(...xs))); x < Math.min(width, Math.max(...xs)); x++) {
      let odd = false;
      corners.forEach((a, k) => {
        const b = corners[(k + 1) % corners.length], py = y + 0.5;
        if (a.y > py !== b.y > py && x + 0.5 < a.x + ((py - a.y) / (b.y - a.y)) * (b.x - a.x)) odd = !odd;
      });
      if (odd) pixels.push([x, y]);
    }
  return pixels;
}
