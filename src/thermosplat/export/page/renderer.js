// Splats on WebGL 2: sorted from near to far, blended into a picture of floats per spectrum. Colours blend as they are;
// of a spectrum of values the values blend, and the palette comes after, as in the model. Depths blend when asked for.
const CORNER = `#version 300 es
  in vec2 corner;
  void main() { gl_Position = vec4(corner, 0.0, 1.0); }`;

// The colour of each splat towards the eye, one pixel each: spherical harmonics with gsplat's signs and constants.
const COLORS = `#version 300 es
  precision highp float;
  uniform highp sampler2D means, flats, harmonics;
  uniform vec3 eye;
  uniform int bases, wide;
  out vec4 color;
  vec3 of(int entry, int k) {
    int at = entry * bases + k;
    return texelFetch(harmonics, ivec2(at % wide, at / wide), 0).rgb;
  }
  void main() {
    ivec2 here = ivec2(gl_FragCoord.xy);
    vec4 own = texelFetch(flats, here, 0);
    vec3 sum = 0.28209479177387814 * own.rgb, d = normalize(texelFetch(means, here, 0).xyz - eye);
    int e = int(own.a);
    float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
    if (bases >= 3) sum += 0.4886025119029199 * (-y * of(e, 0) + z * of(e, 1) - x * of(e, 2));
    if (bases >= 8) sum += 1.0925484305920792 * (x * y * of(e, 3) - y * z * of(e, 4) - x * z * of(e, 6))
      + 0.31539156525252005 * (2.0 * zz - xx - yy) * of(e, 5) + 0.5462742152960396 * (xx - yy) * of(e, 7);
    if (bases >= 15) sum += -0.5900435899266435 * (y * (3.0 * xx - yy) * of(e, 8) + x * (xx - 3.0 * yy) * of(e, 14))
      + 2.890611442640554 * x * y * z * of(e, 9) + 1.445305721320277 * z * (xx - yy) * of(e, 13)
      - 0.4570457994644658 * (4.0 * zz - xx - yy) * (y * of(e, 10) + x * of(e, 12))
      + 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * of(e, 11);
    color = vec4(max(sum + 0.5, 0.0), 1.0);
  }`;

// Where each splat lies in the picture, in the order of their depths: its middle, its axes up to 3.33 standard
// deviations, or up to where its alpha is below 1/255, as the rasterizer has them, and what blends.
const PROJECTION = `#version 300 es
  precision highp float;
  uniform highp usampler2D order;
  uniform highp sampler2D means, covariances, colors;
  uniform int columns, count;
  uniform bool depth;
  uniform mat3 turn;
  uniform vec3 shift;
  uniform vec2 focal, middle, size;
  layout(location = 0) out vec4 place;
  layout(location = 1) out vec4 axes;
  layout(location = 2) out vec4 shade;
  void main() {
    ivec2 here = ivec2(gl_FragCoord.xy);
    if (here.y * columns + here.x >= count) discard;
    int i = int(texelFetch(order, here, 0).r);
    ivec2 at = ivec2(i % columns, i / columns);
    vec4 mean = texelFetch(means, at, 0), color = texelFetch(colors, at, 0);
    at.x *= 2;
    vec3 m = texelFetch(covariances, at, 0).xyz, n = texelFetch(covariances, at + ivec2(1, 0), 0).xyz;
    mat3 covariance = mat3(m, vec3(m.y, n.xy), vec3(m.z, n.yz));
    vec3 p = turn * mean.xyz + shift;
    vec2 edge = 0.15 * size / focal, ray = clamp(p.xy / p.z, -middle / focal - edge, (size - middle) / focal + edge);
    mat3x2 jacobian = mat3x2(focal.x / p.z, 0.0, 0.0, focal.y / p.z, -focal * ray / p.z);
    mat3x2 onto = jacobian * turn;
    mat2 c = onto * covariance * transpose(onto) + mat2(0.3, 0.0, 0.0, 0.3);
    float half_sum = 0.5 * (c[0][0] + c[1][1]), apart = length(vec2(0.5 * (c[0][0] - c[1][1]), c[0][1]));
    vec2 first = vec2(c[0][1], half_sum + apart - c[0][0]);
    first = dot(first, first) > 1e-12 ? normalize(first) : (c[0][0] >= c[1][1] ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
    float extent = min(3.33, sqrt(2.0 * log(max(255.0 * mean.w, 1.0))));
    place = vec4(2.0 * (focal * p.xy / p.z + middle) / size - 1.0, extent, 0.0);
    axes = vec4(sqrt(half_sum + apart) * first, sqrt(max(half_sum - apart, 0.0)) * vec2(-first.y, first.x));
    axes *= extent * 2.0 / size.xyxy;
    shade = vec4(depth ? vec3(p.z) : color.rgb, mean.w);
  }`;

const SPLAT = `#version 300 es
  precision highp float;
  uniform highp sampler2D places, axes, shades;
  uniform int columns;
  flat out vec4 shade;
  out vec2 along;
  void main() {
    int i = gl_VertexID / 4;
    ivec2 at = ivec2(i % columns, i / columns);
    vec2 corner = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0;
    vec4 place = texelFetch(places, at, 0), axis = texelFetch(axes, at, 0);
    shade = texelFetch(shades, at, 0);
    along = corner * place.z;
    gl_Position = vec4(place.xy + corner.x * axis.xy + corner.y * axis.zw, 0.0, 1.0);
  }`;

const BLEND = `#version 300 es
  precision highp float;
  flat in vec4 shade;
  in vec2 along;
  out vec4 color;
  void main() {
    float alpha = min(0.999, shade.a * exp(-0.5 * dot(along, along)));
    if (alpha < 1.0 / 255.0) discard;
    color = vec4(shade.rgb * alpha, alpha);
  }`;

// Row 0 of the blended pictures is the top one; the canvas has it at its end.
const SHOWN = `#version 300 es
  precision highp float;
  uniform highp sampler2D first, second, palette;
  uniform bvec2 value;
  uniform vec4 span;
  uniform vec3 back0, back1;
  uniform vec3 band;
  uniform vec2 size;
  uniform float wipe, share;
  out vec4 color;
  vec3 seen(vec4 pixel, vec3 back, bool value, vec2 span) {
    pixel.rgb += (1.0 - pixel.a) * back;
    if (!value) return clamp(pixel.rgb, 0.0, 1.0);
    if (band.z > 0.5 && pixel.r >= band.x && pixel.r <= band.y) return vec3(0.1, 0.95, 0.35);
    float at = clamp((pixel.r - span.x) / max(span.y - span.x, 1e-9), 0.0, 1.0);
    return texture(palette, vec2((at * 255.0 + 0.5) / 256.0, 0.5)).rgb;
  }
  void main() {
    ivec2 here = ivec2(int(gl_FragCoord.x), int(size.y - gl_FragCoord.y));
    vec3 one = seen(texelFetch(first, here, 0), back0, value.x, span.xy);
    vec3 other = seen(texelFetch(second, here, 0), back1, value.y, span.zw);
    color = vec4(mix(one, other, gl_FragCoord.x > wipe * size.x ? share : 0.0), 1.0);
  }`;

class Renderer {
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("This browser has no WebGL 2, which the page needs.");
    this.gl = gl;
    const floats = gl.getExtension("EXT_color_buffer_float");
    if (!floats && !gl.getExtension("EXT_color_buffer_half_float"))
      throw new Error("This graphics card cannot blend values (EXT_color_buffer_float), which the page needs.");
    this.format = floats && gl.getExtension("EXT_float_blend") ? gl.RGBA32F : gl.RGBA16F;
    this.widest = Math.min(gl.getParameter(gl.MAX_TEXTURE_SIZE), 8192);
    this.corners = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.corners);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
    this.whole = gl.createVertexArray();
    gl.bindVertexArray(this.whole);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
    this.many = gl.createVertexArray();
    this.most = 0;
    const pairs = [[CORNER, COLORS], [CORNER, PROJECTION], [SPLAT, BLEND], [CORNER, SHOWN]];
    [this.coloring, this.projecting, this.blending, this.showing] = pairs.map((pair) => this.program(...pair));
    this.palette = this.texture(gl.RGBA8, 256, 1, gl.RGBA, gl.UNSIGNED_BYTE, null);
    this.nothing = this.texture(gl.RGBA8, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, null);
  }

  program(...sources) {
    const gl = this.gl, program = gl.createProgram();
    sources.forEach((source, k) => {
      const shader = gl.createShader(k ? gl.FRAGMENT_SHADER : gl.VERTEX_SHADER);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    });
    gl.bindAttribLocation(program, 0, "corner");
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost())
      throw new Error("This graphics card cannot draw splats: "
        + (gl.getProgramInfoLog(program) || gl.getAttachedShaders(program).map((one) => gl.getShaderInfoLog(one)).join(" ")));
    const places = {};
    for (let k = 0; k < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); k++) {
      const { name } = gl.getActiveUniform(program, k);
      places[name] = gl.getUniformLocation(program, name);
    }
    return { program, places };
  }

  texture(internal, width, height, format, type, data) {
    const gl = this.gl, made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, type, data);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
    return made;
  }

  // Something to draw into: so many textures.
  target(width, height, count = 1) {
    const gl = this.gl, frame = gl.createFramebuffer(), type = this.format === gl.RGBA32F ? gl.FLOAT : gl.HALF_FLOAT;
    const textures = Array.from({ length: count }, () => this.texture(this.format, width, height, gl.RGBA, type, null));
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    textures.forEach((texture, k) =>
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + k, gl.TEXTURE_2D, texture, 0));
    gl.drawBuffers(textures.map((_, k) => gl.COLOR_ATTACHMENT0 + k));
    return { frame, textures, width, height };
  }

  // A table of numbers, `each` pixels of `channels` numbers per row of it, in rows of `columns` such groups.
  table(numbers, channels, each, columns) {
    const gl = this.gl, rows = Math.max(1, Math.ceil(numbers.length / (channels * each * columns)));
    const padded = new Float32Array(rows * columns * each * channels);
    padded.set(numbers);
    const [internal, format] = { 1: [gl.R32F, gl.RED], 3: [gl.RGB32F, gl.RGB], 4: [gl.RGBA32F, gl.RGBA] }[channels];
    return this.texture(internal, columns * each, rows, format, gl.FLOAT, padded);
  }

  add(splats) {
    const gl = this.gl, columns = Math.max(1, Math.min(this.widest / 2, Math.ceil(Math.sqrt(splats.count))));
    const rows = Math.max(1, Math.ceil(splats.count / columns));
    if (splats.count > this.most) this.makeRoom(splats.count);
    return {
      ...splats, columns, rows,
      means: this.table(splats.means, 4, 1, columns), places: splats.means,
      covariances: this.table(splats.covariances, 3, 2, columns),
      flats: this.table(splats.flat, 4, 1, columns),
      harmonics: splats.bases ? this.table(splats.harmonics, splats.channels === 3 ? 4 : 1, 1, this.widest) : this.nothing,
      order: this.texture(gl.R32UI, columns, rows, gl.RED_INTEGER, gl.UNSIGNED_INT, null),
      colors: this.target(columns, rows), projected: this.target(columns, rows, 3), picture: null, seen: "", eye: "",
      sorted: new Uint32Array(columns * rows), depths: new Float32Array(splats.count), kept: new Uint32Array(splats.count),
    };
  }

  // Two triangles for each splat. Not instances: drawing in software begins anew with each of them.
  makeRoom(count) {
    const gl = this.gl, corners = new Uint32Array(6 * count);
    for (let i = 0; i < count; i++) corners.set([4 * i, 4 * i + 1, 4 * i + 2, 4 * i + 2, 4 * i + 1, 4 * i + 3], 6 * i);
    this.most = count;
    gl.bindVertexArray(this.many);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
  }

  // Splats within the picture from near to far, as a counting sort of the first bits of their depths has them.
  sort(set, { turn, shift, focal, middle, size }) {
    const { count, places, radii, depths, kept, sorted } = set, bits = new Uint32Array(depths.buffer);
    const wide = Math.max(middle[0], size[0] - middle[0]) / focal[0], tall = Math.max(middle[1], size[1] - middle[1]) / focal[1];
    const slantX = Math.hypot(1, wide), slantY = Math.hypot(1, tall);
    const [a, b, c, d, e, f, g, h, k] = turn, [x0, y0, z0] = shift;
    let seen = 0, least = 0xffffffff, most = 0;
    for (let i = 0; i < count; i++) {
      const x = places[4 * i], y = places[4 * i + 1], z = places[4 * i + 2], depth = g * x + h * y + k * z + z0;
      if (depth < 0.01) continue;
      const r = radii[i];
      if (Math.abs(a * x + b * y + c * z + x0) > wide * depth + slantX * r + 0.02 * depth) continue;
      if (Math.abs(d * x + e * y + f * z + y0) > tall * depth + slantY * r + 0.02 * depth) continue;
      depths[seen] = depth;
      const key = bits[seen] >>>= 11;
      if (key < least) least = key;
      if (key > most) most = key;
      kept[seen++] = i;
    }
    const starts = new Uint32Array(seen ? most - least + 2 : 1);
    for (let i = 0; i < seen; i++) starts[bits[i] - least + 1]++;
    for (let i = 1; i < starts.length; i++) starts[i] += starts[i - 1];
    for (let i = 0; i < seen; i++) sorted[starts[bits[i] - least]++] = kept[i];
    return seen;
  }

  use({ program, places }, textures) {
    const gl = this.gl;
    gl.useProgram(program);
    Object.entries(textures).forEach(([name, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(places[name], unit);
    });
    return places;
  }

  // Draw a set as a camera sees it; nothing where that is there already.
  draw(set, camera, depth = false) {
    const gl = this.gl, { turn, shift, size: [width, height] } = camera, seen = JSON.stringify([camera, depth]);
    if (set.seen === seen) return;
    if (set.picture?.width !== width || set.picture?.height !== height) {
      if (set.picture) gl.deleteFramebuffer(set.picture.frame), gl.deleteTexture(set.picture.textures[0]);
      set.picture = this.target(width, height);
    }
    gl.disable(gl.BLEND);
    gl.bindVertexArray(this.whole);
    const eye = [0, 1, 2].map((k) => -(turn[k] * shift[0] + turn[3 + k] * shift[1] + turn[6 + k] * shift[2]));
    if (set.eye !== String(eye)) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, set.colors.frame);
      gl.viewport(0, 0, set.columns, set.rows);
      const places = this.use(this.coloring, { means: set.means, flats: set.flats, harmonics: set.harmonics });
      gl.uniform3fv(places.eye, eye);
      gl.uniform1i(places.bases, set.bases);
      gl.uniform1i(places.wide, this.widest);
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
      set.eye = String(eye);
    }
    const count = this.sort(set, camera);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, set.order);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, set.columns, set.rows, gl.RED_INTEGER, gl.UNSIGNED_INT, set.sorted);
    this.project(set, camera, count, depth);
    this.blend(set, count);
    set.seen = seen;
  }

  project(set, { turn, shift, focal, middle, size }, count, depth) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, set.projected.frame);
    gl.viewport(0, 0, set.columns, Math.max(1, Math.ceil(count / set.columns)));
    const read = { order: set.order, means: set.means, covariances: set.covariances, colors: set.colors.textures[0] };
    const places = this.use(this.projecting, read);
    gl.uniform1i(places.columns, set.columns);
    gl.uniform1i(places.count, count);
    gl.uniform1i(places.depth, depth);
    gl.uniformMatrix3fv(places.turn, true, turn);
    gl.uniform3fv(places.shift, shift);
    for (const [name, pair] of Object.entries({ focal, middle, size })) gl.uniform2fv(places[name], pair);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }

  blend(set, count) {
    const gl = this.gl, { frame, width, height } = set.picture, [place, axes, shades] = set.projected.textures;
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE_MINUS_DST_ALPHA, gl.ONE);
    gl.uniform1i(this.use(this.blending, { places: place, axes, shades }).columns, set.columns);
    gl.bindVertexArray(this.many);
    gl.drawElements(gl.TRIANGLES, 6 * count, gl.UNSIGNED_INT, 0);
  }

  // The pictures of two layers on the canvas: {set, span, back} each; the second one behind the wipe, by its share.
  show(first, second, { wipe, share, band }) {
    const gl = this.gl, { width, height } = first.set.picture;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.BLEND);
    const textures = { first: first.set.picture.textures[0], second: second.set.picture.textures[0], palette: this.palette };
    const places = this.use(this.showing, textures);
    gl.uniform2i(places.value, first.set.channels === 1, second.set.channels === 1);
    gl.uniform4fv(places.span, [...first.span, ...second.span]);
    gl.uniform3fv(places.back0, first.back);
    gl.uniform3fv(places.back1, second.back);
    gl.uniform3fv(places.band, band);
    gl.uniform2f(places.size, width, height);
    gl.uniform1f(places.wipe, wipe);
    gl.uniform1f(places.share, share);
    gl.bindVertexArray(this.whole);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }

  // What was blended in some pixels of a set: four numbers each, the sums and the cover.
  read(set, x, y, width, height) {
    const gl = this.gl, numbers = new Float32Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, set.picture.frame);
    gl.readPixels(x, y, width, height, gl.RGBA, gl.FLOAT, numbers);
    return numbers;
  }

  setPalette(bytes) {
    const gl = this.gl;
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.palette);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
  }
}
