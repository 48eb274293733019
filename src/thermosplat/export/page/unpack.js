// From the page's text to numbers: what packed_splats.py wrote.
const textOf = (id) => document.getElementById(id).textContent;

async function unzipped(base64) {
  const text = atob(base64), bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

// Means with opacities [N, 4], covariances [N, 6], colours of degree 0 [N, 4], harmonics [entries, bases, 4 or 1].
function splatsOf({ count, bases, channels, entries, level, smallest }, buffer) {
  let offset = 0;
  const take = (Type, length) => {
    const part = new Type(buffer, offset, length);
    offset += part.byteLength;
    return part;
  };
  const chunks = Math.ceil(count / 256);
  const bounds = take(Float32Array, 6 * chunks);
  const colorBook = channels === 3 ? take(Float32Array, 256) : null;
  const harmonicBook = bases ? take(Float32Array, 256) : null;
  const positions = take(Uint16Array, 3 * count), scales = take(Uint16Array, 3 * count), opacities = take(Uint16Array, count);
  const levels = channels === 1 ? take(Uint16Array, count) : null;
  const labels = channels === 3 && bases ? take(Uint16Array, count) : null;
  const quats = take(Uint8Array, 4 * count);
  const colors = channels === 3 ? take(Uint8Array, 3 * count) : null;
  const indices = take(Uint8Array, entries * bases * channels);

  const means = new Float32Array(4 * count), covariances = new Float32Array(6 * count);
  const flat = new Float32Array(4 * count), radii = new Float32Array(count), q = [0, 0, 0, 0];
  for (let i = 0; i < count; i++) {
    const chunk = 6 * (i >> 8);
    for (let k = 0; k < 3; k++) {
      const low = bounds[chunk + k], high = bounds[chunk + 3 + k];
      means[4 * i + k] = low + ((high - low) * positions[k * count + i]) / 65535;
    }
    means[4 * i + 3] = opacities[i] / 4095;
    const largest = quats[3 * count + i];
    let rest = 1, from = 0;
    for (let k = 0; k < 4; k++) {
      if (k === largest) continue;
      q[k] = (quats[from++ * count + i] / 255 - 0.5) * Math.SQRT2;
      rest -= q[k] * q[k];
    }
    q[largest] = Math.sqrt(Math.max(rest, 0));
    const [w, x, y, z] = q;
    const [a, b, c] = [0, 1, 2].map((k) => Math.exp(2 * (smallest + scales[k * count + i] / 128)));
    const r = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
      2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
      2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)];
    const of = (m, n) => r[3 * m] * r[3 * n] * a + r[3 * m + 1] * r[3 * n + 1] * b + r[3 * m + 2] * r[3 * n + 2] * c;
    covariances.set([of(0, 0), of(0, 1), of(0, 2), of(1, 1), of(1, 2), of(2, 2)], 6 * i);
    radii[i] = 3.33 * Math.sqrt(Math.max(a, b, c));
    if (levels) flat[4 * i] = level[0] + ((level[1] - level[0]) * levels[i]) / 65535;
    else for (let k = 0; k < 3; k++) flat[4 * i + k] = colorBook[colors[k * count + i]];
    flat[4 * i + 3] = labels ? labels[i] : i;
  }
  const wide = channels === 3 ? 4 : 1, harmonics = new Float32Array(wide * entries * bases);
  for (let k = 0; k < bases * channels; k++)
    for (let e = 0, to = wide * Math.floor(k / channels) + (k % channels); e < entries; e++, to += wide * bases)
      harmonics[to] = harmonicBook[indices[k * entries + e]];
  return { count, bases, channels, means, covariances, flat, radii, harmonics };
}
