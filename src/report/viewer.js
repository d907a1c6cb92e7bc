// A head to turn: shows the GLB inside the page with WebGL 2, alone and from the places of the
// photographs.
//
// Coordinates are the file's own, +Y up, kept in f64 around the middle of the mesh until they meet
// the graphics card. Colors that change with the view are those of docs/view-dependent-color.md:
//
//     base + sum over k of L_k Y_k(d),     L_k = (byte - 128) / 127 * scale[k]
//
// in sRGB-coded values; d is the unit vector from the point to the viewer. Primitives whose
// material says BLEND are drawn after all others, in the order of the file, without their back
// faces and without writing depth.

"use strict";

(() => {
/** Y_k of the unit vector d. */
const BASIS = [
  "0.28209479", "-0.48860251 * d.y", "0.48860251 * d.z", "-0.48860251 * d.x", "1.0925484 * d.x * d.y",
  "-1.0925484 * d.y * d.z", "0.9461747 * d.z * d.z - 0.31539157", "-1.0925484 * d.x * d.z",
  "0.5462742 * (d.x * d.x - d.y * d.y)",
];
const MODES = ["view", "texture", "normals", "shape", "wire", "seen"];
/** Colors of what no camera sees, one, two, and three or more: those of `tiface preview --light seen`. */
const SEEN_BY = ["0.55, 0.1, 0.15", "0.85, 0.45, 0.1", "0.95, 0.8, 0.3", "0.75, 0.9, 0.8"];
/** Field of view of a lens whose picture is as wide as two fifths of its distance. */
const FIELD_OF_VIEW = 2 * Math.atan(0.2);
/** Share of the picture that a mesh fills at first. */
const FILLED = 0.95;
/** Where the attributes of a vertex are bound, and what stands for one that is missing. */
const ATTRIBUTES = [["POSITION", [0, 0, 0, 1]], ["NORMAL", [0, 0, 0, 0]], ["TEXCOORD_0", [0, 0, 0, 0]], ["COLOR_0", [1, 1, 1, 1]],
  ["_SEEN_BY", [0, 0, 0, 1]]];
const BYTES = { 5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4 };
const WIDTH = { SCALAR: 1, VEC2: 2, VEC3: 3, VEC4: 4 };

const add = (a, b, k = 1) => a.map((v, i) => v + k * b[i]);
const dot = (a, b) => a.reduce((sum, v, i) => sum + v * b[i], 0);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((v) => v / (Math.hypot(...a) || 1));
const clamp = (v, low, high) => Math.min(high, Math.max(low, v));
const IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
/** The product of two matrices, column by column. */
const times = (a, b) => Array.from({ length: 16 }, (_, i) =>
  [0, 1, 2, 3].reduce((sum, k) => sum + a[i % 4 + 4 * k] * b[k + 4 * (i >> 2)], 0));
const apply = (m, p) => [0, 1, 2].map((r) => m[r] * p[0] + m[4 + r] * p[1] + m[8 + r] * p[2] + m[12 + r]);

/** The matrix of a glTF node. */
function ofNode({ matrix, translation: t = [0, 0, 0], rotation: [x, y, z, w] = [0, 0, 0, 1], scale: s = [1, 1, 1] }) {
  if (matrix) return matrix;
  return [
    s[0] * (1 - 2 * (y * y + z * z)), s[0] * 2 * (x * y + z * w), s[0] * 2 * (x * z - y * w), 0,
    s[1] * 2 * (x * y - z * w), s[1] * (1 - 2 * (x * x + z * z)), s[1] * 2 * (y * z + x * w), 0,
    s[2] * 2 * (x * z + y * w), s[2] * 2 * (y * z - x * w), s[2] * (1 - 2 * (x * x + y * y)), 0, ...t, 1];
}

/** The document and the bytes of a GLB. */
function parse(buffer) {
  const view = new DataView(buffer), length = view.getUint32(12, true);
  const json = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 20, length)));
  const bin = new Uint8Array(buffer, 28 + length);
  const bytes = (index) => {
    const { byteOffset = 0, byteLength } = json.bufferViews[index];
    return bin.subarray(byteOffset, byteOffset + byteLength);
  };
  const accessor = (index) => {
    const a = json.accessors[index], size = WIDTH[a.type], element = size * BYTES[a.componentType];
    return { ...a, size, element, stride: json.bufferViews[a.bufferView].byteStride ?? element,
      offset: a.byteOffset ?? 0, bytes: bytes(a.bufferView) };
  };
  /** The primitives in the order of the file, each with the matrix of its node. */
  const primitives = [], seen = new Set();
  const walk = (index, parent) => {
    if (seen.has(index)) throw new Error(`node ${index} is reached twice`);
    seen.add(index);
    const node = json.nodes[index], matrix = times(parent, ofNode(node));
    for (const p of node.mesh === undefined ? [] : json.meshes[node.mesh].primitives) {
      const attributes = {};
      for (const [name] of ATTRIBUTES) if (name in p.attributes) attributes[name] = accessor(p.attributes[name]);
      primitives.push({ matrix, attributes, indices: p.indices === undefined ? null : accessor(p.indices),
        material: json.materials?.[p.material] ?? {} });
    }
    (node.children ?? []).forEach((child) => walk(child, matrix));
  };
  json.scenes[json.scene ?? 0].nodes.forEach((node) => walk(node, IDENTITY));
  return { json, primitives, picture: (texture) => {
    const { bufferView, mimeType } = json.images[json.textures[texture].source];
    return new Blob([bytes(bufferView)], { type: mimeType });
  } };
}

/** Where the corners of all boxes lie: the middle, how far the farthest is from it, and half the sides. */
function extent(primitives) {
  let low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (const { matrix, attributes: { POSITION: { min, max, normalized, componentType } } } of primitives) {
    const scale = normalized ? { 5121: 255, 5123: 65535, 5120: 127, 5122: 32767 }[componentType] : 1;
    for (let i = 0; i < 8; i++) {
      const p = apply(matrix, [0, 1, 2].map((k) => (i >> k & 1 ? max : min)[k] / scale));
      low = low.map((v, k) => Math.min(v, p[k]));
      high = high.map((v, k) => Math.max(v, p[k]));
    }
  }
  return { middle: low.map((v, k) => (v + high[k]) / 2), radius: Math.hypot(...add(high, low, -1)) / 2,
    half: add(high, low, -1).map((v) => v / 2) };
}

/** What every fragment knows: the colors of errors, and the photograph behind it. */
const shared = (heat) => `
vec3 heat(float t) {
  const vec3 stops[${heat.length}] = vec3[${heat.length}](${heat.map((c) => `vec3(${c.map((v) => (v / 255).toFixed(4))})`)});
  float at = clamp(t, 0.0, 1.0) * ${heat.length - 1}.0;
  int k = min(int(at), ${heat.length - 2});
  return mix(stops[k], stops[k + 1], at - float(k));
}
uniform sampler2D photo;
uniform vec4 frame;     // left, bottom, width, height of the photograph on the canvas; no width: none is shown
uniform float fade;     // 0 photograph, 1 mesh, 2 error
uniform float most;     // the error that is brightest
bool framed(out vec3 seen) {
  vec2 at = (gl_FragCoord.xy - frame.xy) / max(frame.zw, vec2(1e-6));
  seen = frame.z > 0.0 ? texture(photo, vec2(at.x, 1.0 - at.y)).rgb : vec3(0.0);
  return frame.z > 0.0 && all(greaterThanEqual(at, vec2(0.0))) && all(lessThan(at, vec2(1.0)));
}`;

const behind = (known) => [`#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1), 1.0, 1.0); }`,
`#version 300 es
precision highp float;
uniform vec3 ground;
out vec4 color;
${known}
void main() {
  vec3 seen;
  color = vec4(framed(seen) ? mix(seen, ground, min(fade, 1.0)) : ground, 1.0);
}`];

const VERTEX = `#version 300 es
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec2 uv;
layout(location = 3) in vec4 color;
layout(location = 4) in float seenBy;
uniform mat4 clipFromModel, placeFromModel;
uniform mat3 normalFromModel;
out vec3 place, around, corner;
out vec2 at;
out vec4 tint;
out float watched;
void main() {
  watched = min(seenBy, 3.0);
  place = (placeFromModel * vec4(position, 1.0)).xyz;
  around = normalFromModel * normal;
  at = uv;
  tint = color;
  int k = gl_VertexID % 3;
  corner = vec3(k == 0, k == 1, k == 2);
  gl_Position = clipFromModel * vec4(position, 1.0);
}`;

const fragment = (known, textured, lobes) => `#version 300 es
precision highp float;
in vec3 place, around, corner;
in vec2 at;
in vec4 tint;
in float watched;
uniform vec3 eye;
uniform mat3 viewFromPlace;
uniform vec4 factor;
uniform float cutoff;
uniform int mode;
uniform sampler2D base;
${Array.from({ length: lobes }, (_, k) => `uniform sampler2D lobe${k};`).join("\n")}
uniform float scale[${Math.max(lobes, 1)}];
out vec4 color;
${known}
vec3 coded(vec3 c) { return mix(12.92 * c, 1.055 * pow(max(c, 1e-9), vec3(1.0 / 2.4)) - 0.055, step(0.0031308, c)); }
void main() {
  vec4 light = factor * tint${textured ? " * texture(base, at)" : ""};
  if (light.a < cutoff) discard;
  vec3 d = normalize(eye - place), c = coded(clamp(light.rgb, 0.0, 1.0)), n = around;
  if (dot(n, n) < 1e-12) n = cross(dFdx(place), dFdy(place));
  n = normalize(n);
  if (mode == 0) {
    vec3 sum = vec3(0.0);
    ${Array.from({ length: lobes }, (_, k) =>
      `sum += (texture(lobe${k}, at).rgb * 255.0 - 128.0) / 127.0 * scale[${k}] * (${BASIS[k]});`).join("\n    ")}
    c = clamp(c + sum, 0.0, 1.0);
  } else if (mode == 2) {
    c = 0.5 + 0.5 * viewFromPlace * n;
  } else if (mode == 5) {
    const vec3 colors[4] = vec3[4](${SEEN_BY.map((c) => `vec3(${c})`)});
    // values at a triangle's border reach beyond those of its corners
    c = colors[clamp(int(watched + 0.5), 0, 3)];
  } else if (mode >= 3) {
    c = vec3(0.83, 0.80, 0.77) * (0.2 + 0.8 * abs(dot(n, d)));
  }
  if (mode == 4) {
    // where triangles are smaller than a few pixels, lines would hide the shape
    vec3 width = fwidth(corner), line = smoothstep(0.3 * width, 1.2 * width, corner);
    float dense = clamp(0.18 / max(max(width.x, width.y), width.z), 0.1, 1.0);
    c = mix(c, vec3(0.16, 0.18, 0.22), dense * (1.0 - min(min(line.x, line.y), line.z)));
  }
  vec3 seen;
  if (framed(seen)) {
    vec3 apart = abs(seen - c);
    c = fade < 1.0 ? mix(seen, c, fade) : mix(c, heat((apart.r + apart.g + apart.b) / 3.0 / most), fade - 1.0);
  }
  color = vec4(c, light.a);
}`;

/** What draws one file on one canvas. */
class Painter {
  constructor(gl, file, heat) {
    this.gl = gl;
    this.programs = new Map();
    this.known = shared(heat);
    this.behind = this.program("behind", ...behind(this.known));
    this.nothing = gl.createVertexArray();
    const solid = file.primitives.filter((p) => p.material.alphaMode !== "BLEND");
    Object.assign(this, extent(solid.length ? solid : file.primitives));
    this.parts = file.primitives.map((p) => this.part(p));
    this.solid = this.parts.filter((p) => !p.blend);
    this.shells = this.parts.filter((p) => p.blend);
    this.lobes = Math.max(...this.parts.map((p) => p.lobes.length));
    this.knowsCameras = this.solid.some((p) => p.attributes._SEEN_BY);
    this.colored = this.parts.some((p) => p.texture !== undefined || p.attributes.COLOR_0);
  }

  program(key, vertex, text) {
    const { gl } = this;
    if (!this.programs.has(key)) {
      const program = gl.createProgram(), places = {};
      for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, text]]) {
        const shader = gl.createShader(kind);
        gl.shaderSource(shader, source);
        gl.compileShader(shader);
        gl.attachShader(program, shader);
      }
      gl.linkProgram(program);
      if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program) || "no shader");
      for (let i = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) - 1; i >= 0; i--) {
        const name = gl.getActiveUniform(program, i).name.replace("[0]", "");
        places[name] = gl.getUniformLocation(program, name);
      }
      this.programs.set(key, { program, places });
    }
    return this.programs.get(key);
  }

  part({ matrix, attributes, indices, material }) {
    const pbr = material.pbrMetallicRoughness ?? {}, notes = material.extras?.tiface;
    const lobes = (notes?.lobes ?? []).slice(0, BASIS.length);
    const placed = [...matrix.slice(0, 12), ...add(matrix.slice(12, 15), this.middle, -1), 1];
    // of a normal: the cofactors, which are the transposed inverse but for a factor
    const [x, y, z] = [0, 4, 8].map((k) => placed.slice(k, k + 3));
    const turned = [...cross(y, z), ...cross(z, x), ...cross(x, y)].map((v) => v / (Math.hypot(...cross(y, z)) || 1));
    const part = { placed, turned, attributes, indices, blend: material.alphaMode === "BLEND", bothSides: material.doubleSided === true,
      cutoff: material.alphaMode === "MASK" ? material.alphaCutoff ?? 0.5 : -1,
      factor: pbr.baseColorFactor ?? [1, 1, 1, 1], texture: pbr.baseColorTexture?.index, lobes,
      scale: notes?.view_dependent_color?.scale ?? [], pictures: [], count: indices?.count ?? attributes.POSITION.count };
    part.shader = this.program(`${part.texture !== undefined} ${lobes.length}`, VERTEX, fragment(this.known, part.texture !== undefined, lobes.length));
    part.whole = this.vertices(part, false);
    return part;
  }

  /** The vertices of a part; apart, three for each triangle, where every triangle needs corners of its own. */
  vertices({ attributes, indices }, apart) {
    const { gl } = this, array = gl.createVertexArray();
    gl.bindVertexArray(array);
    const at = apart && indices && new ({ 1: Uint8Array, 2: Uint16Array, 4: Uint32Array })[BYTES[indices.componentType]](
      indices.bytes.slice(indices.offset, indices.offset + indices.count * indices.element).buffer);
    ATTRIBUTES.forEach(([name, fallback], place) => {
      const a = attributes[name];
      if (!a) return gl.vertexAttrib4f(place, ...fallback);
      let { bytes, stride, offset } = a;
      if (at) {
        bytes = new Uint8Array(at.length * stride);
        at.forEach((v, i) => bytes.set(a.bytes.subarray(offset + v * stride, offset + v * stride + a.element), i * stride));
        offset = 0;
      }
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, bytes, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, a.size, a.componentType, Boolean(a.normalized), stride, offset);
    });
    if (indices && !apart) {
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices.bytes.subarray(indices.offset), gl.STATIC_DRAW);
    }
    gl.bindVertexArray(null);
    return array;
  }

  /** A picture with its mip maps; `light` is decoded from sRGB, all else are numbers as they are. */
  async texture(source, light) {
    const { gl } = this, plain = { premultiplyAlpha: "none", colorSpaceConversion: "none" };
    const bitmap = await createImageBitmap(source, plain);
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, light ? gl.SRGB8_ALPHA8 : gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, bitmap);
    gl.generateMipmap(gl.TEXTURE_2D);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    // coordinates that leave the picture are kept as floats; a head's atlas ends at its edge
    const repeats = this.parts.some((p) => p.attributes.TEXCOORD_0?.componentType === gl.FLOAT);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) {
      gl.texParameteri(gl.TEXTURE_2D, side, repeats ? gl.REPEAT : gl.CLAMP_TO_EDGE);
    }
    return texture;
  }

  async loadTextures(file) {
    const known = new Map();
    const get = (index, light) => {
      const key = `${index} ${light}`;
      if (!known.has(key)) known.set(key, this.texture(file.picture(index), light));
      return known.get(key);
    };
    await Promise.all(this.parts.map(async (part) => {
      const all = [part.texture === undefined ? null : get(part.texture, true), ...part.lobes.map((l) => get(l.texture, false))];
      part.pictures = await Promise.all(all);
    }));
  }

  /** Points and triangles of the solid parts, with places of 32 bits; others cannot be measured. */
  get shape() {
    this.knownShape ??= this.solid.filter((p) => p.attributes.POSITION.componentType === 5126).map(({ placed, attributes, indices }) => {
      const { bytes, offset, stride, count } = attributes.POSITION, read = new DataView(bytes.buffer, bytes.byteOffset + offset);
      const points = Array.from({ length: count }, (_, i) => apply(placed, [0, 4, 8].map((k) => read.getFloat32(i * stride + k, true))));
      const wide = indices && BYTES[indices.componentType], at = indices && new DataView(indices.bytes.buffer, indices.bytes.byteOffset + indices.offset);
      const corner = (i) => !at ? i : wide === 4 ? at.getUint32(4 * i, true) : wide === 2 ? at.getUint16(2 * i, true) : at.getUint8(i);
      return { points, corners: Array.from({ length: indices?.count ?? count }, (_, i) => corner(i)) };
    });
    return this.knownShape;
  }

  /** The first point of the surface along a ray (Moeller and Trumbore 1997). */
  hit(eye, direction) {
    let nearest = Infinity;
    for (const { points, corners } of this.shape) {
      for (let i = 0; i + 2 < corners.length; i += 3) {
        const a = points[corners[i]], ab = add(points[corners[i + 1]], a, -1), ac = add(points[corners[i + 2]], a, -1);
        const p = cross(direction, ac), det = dot(ab, p), from = add(eye, a, -1), q = cross(from, ab);
        const u = dot(from, p) / det, v = dot(direction, q) / det, t = dot(ac, q) / det;
        if (u >= 0 && v >= 0 && u + v <= 1 && t > 0 && t < nearest) nearest = t;
      }
    }
    return nearest < Infinity ? add(eye, direction, nearest) : null;
  }

  /** Draws what a camera sees; the photograph, if any, lies in its frame. */
  draw({ clipFromPlace, viewFromPlace, eye, mode, ground, photo, frame, fade, most }) {
    const { gl } = this;
    const begin = (shader) => {
      gl.useProgram(shader.program);
      gl.activeTexture(gl.TEXTURE0);
      gl.bindTexture(gl.TEXTURE_2D, photo ?? null);
      gl.uniform1i(shader.places.photo, 0);
      gl.uniform4f(shader.places.frame, ...photo ? frame : [0, 0, 0, 0]);
      gl.uniform1f(shader.places.fade, fade);
      gl.uniform1f(shader.places.most, most);
    };
    gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.depthMask(true);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    gl.disable(gl.CULL_FACE);
    begin(this.behind);
    gl.uniform3f(this.behind.places.ground, ...ground);
    gl.bindVertexArray(this.nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.enable(gl.DEPTH_TEST);
    const paint = (part) => {
      const { shader } = part, { places } = shader, wire = mode === 4;
      if (wire) part.apart ??= this.vertices(part, true);
      begin(shader);
      gl.uniformMatrix4fv(places.clipFromModel, false, times(clipFromPlace, part.placed));
      gl.uniformMatrix4fv(places.placeFromModel, false, part.placed);
      gl.uniformMatrix3fv(places.normalFromModel, false, part.turned);
      gl.uniform3f(places.eye, ...eye);
      gl.uniformMatrix3fv(places.viewFromPlace, false, viewFromPlace);
      gl.uniform4f(places.factor, ...part.factor);
      gl.uniform1f(places.cutoff, part.cutoff);
      gl.uniform1i(places.mode, mode);
      if (places.scale) gl.uniform1fv(places.scale, part.lobes.map((_, k) => part.scale[k] ?? 0));
      ["base", ...part.lobes.map((_, k) => `lobe${k}`)].forEach((name, k) => {
        gl.activeTexture(gl.TEXTURE1 + k);
        gl.bindTexture(gl.TEXTURE_2D, part.pictures[k] ?? null);
        gl.uniform1i(places[name] ?? null, 1 + k);
      });
      gl.bindVertexArray(wire ? part.apart : part.whole);
      if (wire || !part.indices) gl.drawArrays(gl.TRIANGLES, 0, part.count);
      else gl.drawElements(gl.TRIANGLES, part.count, part.indices.componentType, 0);
    };
    this.solid.forEach(paint);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.enable(gl.CULL_FACE);
    gl.depthMask(false);
    // they have color, but no shape; unless there is nothing else
    const alone = mode >= 2 && !this.solid.length;
    if (alone) {
      gl.depthMask(true);
      gl.disable(gl.BLEND);
    }
    // the far side of a layer first, as three.js does
    if (mode < 2 || alone) {
      for (const shell of this.shells) {
        for (const hidden of shell.bothSides ? [gl.FRONT, gl.BACK] : [gl.BACK]) {
          gl.cullFace(hidden);
          paint(shell);
        }
      }
    }
    gl.depthMask(true);
    gl.bindVertexArray(null);
  }
}

/** Makes the part of the page in `root` work. */
async function viewer(root) {
  const $ = (selector) => root.querySelector(selector);
  const canvas = $("canvas"), say = (text) => { $(".message").textContent = text; };
  const { cameras, front, most, heat } = JSON.parse($(".viewer-data").textContent);
  const controls = { mode: $(".modes"), camera: $(".camera"), fade: $(".fade"), reset: $(".reset"), full: $(".full"),
    measure: $(".measure"), save: $(".save") };
  const marks = [...root.querySelectorAll(".mark")];
  // browsers that show USDZ themselves do so beside the canvas: on a page, or after a tap in the room
  const native = $(".native"), link = native?.querySelector("a");
  if (native && "HTMLModelElement" in window) {
    const model = document.createElement("model");
    model.setAttribute("src", link.getAttribute("href"));
    native.prepend(model);
    native.hidden = false;
  }
  if (native && link.relList.supports("ar")) native.hidden = false;
  const gl = canvas.getContext("webgl2", { antialias: true, alpha: false });
  if (!gl) {
    root.classList.add("dead");
    return say("This browser shows no WebGL 2, so the head cannot be turned here. Any program that opens GLB files shows it.");
  }
  const packed = atob($(".viewer-glb").textContent.trim());
  const bytes = new Uint8Array(packed.length);
  for (let i = 0; i < packed.length; i++) bytes[i] = packed.charCodeAt(i);
  const file = parse(bytes.buffer);
  let painter, photos, asked = false, drawn = 0, measured = null;
  const state = { mode: 0, camera: -1, fade: 0 };

  const start = () => {
    const yaw = Math.atan2(front[0], front[2]) + 0.6;
    Object.assign(state, { yaw, pitch: 0.15, target: [0, 0, 0], angle: FIELD_OF_VIEW });
    fit(canvas.clientWidth || 1, canvas.clientHeight || 1);
  };
  /** So far away that all of it is seen: the first picture is that of `tiface preview`. */
  const fit = (width, height) => {
    const [right, up, back] = axes(), f = Math.min(width, height) / 2 / Math.tan(state.angle / 2);
    state.distance = painter.radius;
    for (let i = 0; i < 8; i++) {
      const corner = painter.half.map((v, k) => i >> k & 1 ? v : -v);
      const aside = Math.max(Math.abs(dot(corner, right)) / width, Math.abs(dot(corner, up)) / height);
      state.distance = Math.max(state.distance, dot(corner, back) + aside * 2 * f / FILLED);
    }
  };
  /** Right, up and back of the free camera. */
  const axes = () => {
    const [sy, cy, sp, cp] = [Math.sin(state.yaw), Math.cos(state.yaw), Math.sin(state.pitch), Math.cos(state.pitch)];
    return [[cy, 0, -sy], [-sy * sp, cp, -cy * sp], [sy * cp, sp, cy * cp]];
  };
  /** Pose, intrinsics and frame of what is shown on a canvas of this size. */
  const camera = (width, height) => {
    const shown = cameras[state.camera];
    if (!shown) {
      const [right, up, back] = axes(), f = Math.min(width, height) / 2 / Math.tan(state.angle / 2);
      return { right, up, back, eye: add(state.target, back, state.distance), fx: f, fy: f, cx: width / 2, cy: height / 2 };
    }
    const s = Math.min(width / shown.width, height / shown.height);
    const left = (width - s * shown.width) / 2, top = (height - s * shown.height) / 2;
    const [right, up, back] = shown.axes;
    return { right, up, back, eye: add(shown.position, painter.middle, -1), fx: s * shown.fx, fy: s * shown.fy,
      cx: left + s * shown.cx, cy: top + s * shown.cy, frame: [left, top, s * shown.width, s * shown.height] };
  };
  const paint = () => {
    const { width, height } = canvas;
    const { right, up, back, eye, fx, fy, cx, cy, frame } = camera(width, height);
    const depth = dot(eye, back), r = painter.radius * 1.01;
    const far = Math.max(depth + r, 0.02 * r), near = Math.max(depth - r, 0.005 * r);
    const clip = [2 * fx / width, 0, 0, 0, 0, 2 * fy / height, 0, 0, 1 - 2 * cx / width, 2 * cy / height - 1,
      -(far + near) / (far - near), -1, 0, 0, -2 * far * near / (far - near), 0];
    const view = [0, 1, 2].flatMap((k) => [right[k], up[k], back[k], 0]);
    view.push(-dot(right, eye), -dot(up, eye), -dot(back, eye), 1);
    const css = getComputedStyle(canvas).backgroundColor.match(/[\d.]+/g).map((v) => v / 255);
    const turned = [0, 4, 8].flatMap((k) => view.slice(k, k + 3));
    painter.draw({ clipFromPlace: times(clip, view), viewFromPlace: turned, eye, mode: state.mode, ground: css.slice(0, 3),
      photo: photos[state.camera], frame, fade: state.fade, most });
    drawn += 1;
    // the measured points, through the head too
    const ratio = width / (canvas.clientWidth || width);
    marks.forEach((mark, k) => {
      const point = measured?.[k], ray = point && add(point, eye, -1);
      mark.hidden = !point || dot(ray, back) >= 0;
      if (mark.hidden) return;
      mark.style.left = `${(cx - fx * dot(ray, right) / dot(ray, back)) / ratio}px`;
      mark.style.top = `${(cy + fy * dot(ray, up) / dot(ray, back)) / ratio}px`;
    });
  };
  /** Measures from point to point, at a place on the canvas. */
  const pick = (x, y) => {
    const ratio = canvas.width / canvas.clientWidth, { right, up, back, eye, fx, fy, cx, cy } = camera(canvas.width, canvas.height);
    const along = add(add(add([0, 0, 0], right, (x * ratio - cx) / fx), up, (cy - y * ratio) / fy), back, -1);
    const point = painter?.hit(eye, along);
    if (!point) {
      $(".distance").textContent = painter?.shape.length ? "No surface there" : "The points of this file cannot be measured";
      return;
    }
    measured = measured.length === 1 ? [...measured, point] : [point];
    const [a, b] = measured;
    $(".distance").textContent = b ? `${(1000 * Math.hypot(...add(b, a, -1))).toFixed(1)} mm` : "Click on the second point";
    redraw();
  };
  const measure = () => {
    measured = measured ? null : [];
    controls.measure.setAttribute("aria-pressed", String(Boolean(measured)));
    $(".distance").textContent = measured ? "Click on two points" : "";
    redraw();
  };
  const save = () => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([bytes], { type: "model/gltf-binary" }));
    link.download = "head.glb";
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
  };
  const redraw = () => {
    if (asked || !painter) return;
    asked = true;
    requestAnimationFrame(() => {
      asked = false;
      const ratio = Math.min(devicePixelRatio, 2);
      const size = [canvas.clientWidth, canvas.clientHeight].map((v) => Math.max(1, Math.round(v * ratio)));
      if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
      paint();
    });
  };

  /** The free camera stands where the photograph's does. */
  const leave = () => {
    if (state.camera < 0) return;
    const { eye, fx } = camera(canvas.width, canvas.height), [x, y, z] = unit(eye);
    Object.assign(state, { camera: -1, target: [0, 0, 0], distance: Math.hypot(...eye), yaw: Math.atan2(x, z),
      pitch: clamp(Math.asin(y), -1.5, 1.5), angle: 2 * Math.atan(Math.min(canvas.width, canvas.height) / 2 / fx) });
    show();
  };
  const turn = (x, y) => {
    leave();
    state.yaw -= x;
    state.pitch = clamp(state.pitch + y, -1.5, 1.5);
    redraw();
  };
  const pan = (x, y) => {
    leave();
    const [right, up] = axes(), f = Math.min(canvas.clientWidth, canvas.clientHeight) / 2 / Math.tan(state.angle / 2);
    state.target = add(add(state.target, right, -x * state.distance / f), up, y * state.distance / f);
    redraw();
  };
  const zoom = (factor) => {
    leave();
    state.distance = clamp(state.distance / factor, 0.05 * painter.radius, 50 * painter.radius);
    redraw();
  };
  const reset = () => { start(); state.camera = -1; show(); };
  const choose = (mode) => {
    const input = controls.mode.querySelectorAll("input")[mode];
    if (input && !input.disabled) { state.mode = mode; show(); }
  };
  const look = async (index) => {
    state.camera = ((index + 1 + cameras.length + 1) % (cameras.length + 1)) - 1;
    show();
    const shown = cameras[state.camera];
    if (shown?.picture && !photos[state.camera]) {
      const image = document.getElementById(shown.picture), at = state.camera;
      photos[at] = await painter.texture(await image.decode().then(() => image), false);
    }
    redraw();
  };
  /** The controls say what is shown. */
  const show = () => {
    controls.mode.querySelectorAll("input").forEach((input, k) => { input.checked = k === state.mode; });
    controls.camera.value = String(state.camera);
    controls.fade.value = String(state.fade);
    const words = ["photograph", "photograph and mesh", "mesh", "mesh and error", "error"];
    controls.fade.setAttribute("aria-valuetext", words[Math.ceil(2 * state.fade)]);
    root.classList.toggle("photographed", Boolean(cameras[state.camera]?.picture));
    redraw();
  };
  const fade = (value) => { state.fade = clamp(value, 0, 2); show(); };

  controls.mode.addEventListener("change", (e) => choose(MODES.indexOf(e.target.value)));
  controls.camera.addEventListener("change", () => look(Number(controls.camera.value)));
  controls.fade.addEventListener("input", () => fade(Number(controls.fade.value)));
  controls.reset.addEventListener("click", reset);
  controls.measure.addEventListener("click", measure);
  controls.save.addEventListener("click", save);
  controls.full.addEventListener("click", () => document.fullscreenElement ? document.exitFullscreen() : root.requestFullscreen?.());
  const KEYS = {
    ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0), ArrowUp: () => turn(0, -0.1), ArrowDown: () => turn(0, 0.1),
    "Shift+ArrowLeft": () => pan(-20, 0), "Shift+ArrowRight": () => pan(20, 0), "Shift+ArrowUp": () => pan(0, -20),
    "Shift+ArrowDown": () => pan(0, 20), "+": () => zoom(1.1), "=": () => zoom(1.1), "-": () => zoom(1 / 1.1), 0: reset,
    Home: reset, "[": () => look(state.camera - 1), "]": () => look(state.camera + 1), ",": () => fade(state.fade - 0.25),
    ".": () => fade(state.fade + 0.25), f: () => controls.full.click(), m: measure,
    Enter: () => { if (measured) pick(canvas.clientWidth / 2, canvas.clientHeight / 2); },
  };
  canvas.addEventListener("keydown", (e) => {
    if (e.ctrlKey || e.metaKey || e.altKey) return;
    const arrow = e.shiftKey && e.key.startsWith("Arrow"), act = KEYS[arrow ? `Shift+${e.key}` : e.key];
    if (/^[1-6]$/.test(e.key)) choose(Number(e.key) - 1);
    else if (act) act();
    else return;
    e.preventDefault();
  });

  const pointers = new Map();
  let pressed = null;
  canvas.addEventListener("pointerup", (e) => {
    const box = canvas.getBoundingClientRect();
    const still = pressed && Math.hypot(e.clientX - pressed[0], e.clientY - pressed[1]) < 5;
    if (measured && still) pick(e.clientX - box.left, e.clientY - box.top);
  });
  canvas.addEventListener("pointerdown", (e) => {
    canvas.setPointerCapture(e.pointerId);
    pointers.set(e.pointerId, [e.clientX, e.clientY]);
    pressed = pointers.size === 1 && e.button === 0 ? [e.clientX, e.clientY] : null;
  });
  canvas.addEventListener("pointermove", (e) => {
    const before = pointers.get(e.pointerId);
    if (!before) return;
    const now = [e.clientX, e.clientY], [x, y] = add(now, before, -1);
    if (pointers.size === 1) {
      if (e.shiftKey || e.buttons & 6) pan(x, y);
      else turn(x * 0.008, y * 0.008);
    } else {
      const [other] = [...pointers].filter(([id]) => id !== e.pointerId).map(([, p]) => p);
      pan(x / 2, y / 2);
      zoom(Math.hypot(...add(now, other, -1)) / (Math.hypot(...add(before, other, -1)) || 1) || 1);
    }
    pointers.set(e.pointerId, now);
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => pointers.delete(e.pointerId));
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  // a page that is scrolled past must not be caught: the wheel zooms once the canvas has the focus
  canvas.addEventListener("wheel", (e) => {
    if (document.activeElement !== canvas && !document.fullscreenElement) return;
    e.preventDefault();
    zoom(Math.exp(-e.deltaY * (e.deltaMode ? 0.05 : 0.0015)));
  }, { passive: false });

  const begin = async () => {
    photos = [];
    const next = new Painter(gl, file, heat);
    await next.loadTextures(file);
    painter = next;
    const none = painter.lobes === 0;
    controls.mode.querySelector("input").disabled = none;
    controls.mode.querySelector("[value=seen]").closest("label").hidden = !painter.knowsCameras;
    controls.mode.querySelector("[value=seen]").disabled = !painter.knowsCameras;
    if (none) controls.mode.querySelector("label").title = "This file has one color for all views.";
    if (state.distance === undefined) {
      state.mode = !painter.colored ? 3 : none ? 1 : 0;
      start();
    }
    say("");
    await look(state.camera);
  };
  canvas.addEventListener("webglcontextlost", (e) => { e.preventDefault(); painter = null; say("The graphics card is busy …"); });
  canvas.addEventListener("webglcontextrestored", begin);
  new ResizeObserver(redraw).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  say("Loading …");
  await begin();
  /** For programs that drive the page: a picture of this size as a data: address, and how often was drawn. */
  root.viewer = { state, fit, drawn: () => drawn, picture: (width, height) => {
    [canvas.width, canvas.height] = [width, height];
    paint();
    const picture = canvas.toDataURL();
    redraw();
    return picture;
  } };
  root.dispatchEvent(new Event("ready"));
}

for (const root of document.querySelectorAll(".viewer")) {
  viewer(root).catch((e) => {
    root.classList.add("dead");
    root.querySelector(".message").textContent = `The head cannot be shown: ${e.message}`;
  });
}
})();
