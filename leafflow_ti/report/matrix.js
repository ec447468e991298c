"use strict";
/* Packed arrays, and the few matrices that a view along parallel lines needs. Matrices are 3 x 3, row by row. */

/** Bytes of a base64 text, inflated. */
async function inflated(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}

/** An array whose rows of `width` numbers were replaced by their differences; Type: Uint16Array or Uint32Array. */
async function unpacked(text, Type, width) {
  const values = new Type(await inflated(text)); // little-endian, as all machines that run browsers are
  for (let i = width; i < values.length; i++) values[i] += values[i - width]; // wraps, as the differences did
  return values;
}

function product(a, b) {
  const c = new Array(9).fill(0);
  for (let i = 0; i < 3; i++)
    for (let j = 0; j < 3; j++) for (let k = 0; k < 3; k++) c[3 * i + j] += a[3 * i + k] * b[3 * k + j];
  return c;
}

/** Turn about the vertical axis, then tilt about the horizontal one. */
function turned(yaw, pitch) {
  const [c, s, d, t] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
  return product([1, 0, 0, 0, d, -t, 0, t, d], [c, 0, s, 0, 1, 0, -s, 0, c]);
}

/** Unit normals at the vertices, means over their triangles. */
function normalsOf(points, triangles) {
  const normals = new Float32Array(points.length);
  for (let t = 0; t < triangles.length; t += 3) {
    const [a, b, c] = [3 * triangles[t], 3 * triangles[t + 1], 3 * triangles[t + 2]];
    const u = [points[b] - points[a], points[b + 1] - points[a + 1], points[b + 2] - points[a + 2]];
    const v = [points[c] - points[a], points[c + 1] - points[a + 1], points[c + 2] - points[a + 2]];
    const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
    for (const at of [a, b, c]) for (let k = 0; k < 3; k++) normals[at + k] += n[k];
  }
  for (let i = 0; i < normals.length; i += 3) {
    const length = Math.hypot(normals[i], normals[i + 1], normals[i + 2]) || 1;
    for (let k = 0; k < 3; k++) normals[i + k] /= length;
  }
  return normals;
}

/** Triangles of arrows: [points, normals]. tails, spans: [n * 3]; width: radius of a shaft. */
function arrowTriangles(tails, spans, width) {
  const sides = 7, points = [], normals = [];
  const put = (origin, axis, u, v, angle, along, radius, slope) => {
    const [c, s] = [Math.cos(angle), Math.sin(angle)];
    for (let k = 0; k < 3; k++) {
      const out = u[k] * c + v[k] * s;
      points.push(origin[k] + axis[k] * along + radius * out);
      normals.push(out + axis[k] * slope);
    }
  };
  for (let i = 0; i < tails.length; i += 3) {
    const length = Math.hypot(spans[i], spans[i + 1], spans[i + 2]);
    if (length < 1e-9) continue;
    const origin = [tails[i], tails[i + 1], tails[i + 2]];
    const axis = [spans[i] / length, spans[i + 1] / length, spans[i + 2] / length];
    const aside = Math.abs(axis[0]) < 0.7 ? [1, 0, 0] : [0, 1, 0];
    let u = [axis[1] * aside[2] - axis[2] * aside[1], axis[2] * aside[0] - axis[0] * aside[2], axis[0] * aside[1] - axis[1] * aside[0]];
    const norm = Math.hypot(...u);
    u = u.map((x) => x / norm);
    const v = [axis[1] * u[2] - axis[2] * u[1], axis[2] * u[0] - axis[0] * u[2], axis[0] * u[1] - axis[1] * u[0]];
    const head = Math.min(0.45 * length, 6 * width), neck = length - head, rim = Math.min(2.6 * width, 0.45 * head);
    const shaft = Math.min(width, 0.6 * rim);
    for (let s = 0; s < sides; s++) {
      const [a, b] = [(2 * Math.PI * s) / sides, (2 * Math.PI * (s + 1)) / sides];
      for (const [angle, along] of [[a, 0], [b, 0], [b, neck], [a, 0], [b, neck], [a, neck]])
        put(origin, axis, u, v, angle, along, shaft, 0);
      for (const [angle, along, radius] of [[a, neck, rim], [b, neck, rim], [a, length, 0]])
        put(origin, axis, u, v, angle, along, radius, 0.4);
    }
  }
  return [new Float32Array(points), new Float32Array(normals)];
}
