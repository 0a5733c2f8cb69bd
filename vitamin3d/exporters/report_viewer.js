// SPDX-License-Identifier: Apache-2.0
// The 3D view of report.html: mesh, cloud and lines in WebGL 2, without a library and without a network.
"use strict";
(() => {
  const SCENE = JSON.parse(document.getElementById("scene").textContent);
  const TRUTH = JSON.parse(document.getElementById("truth").textContent);
  const canvas = document.getElementById("view");
  const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
  const report = (window.vitamin3dReport = { ready: false, draws: 0, triangles: 0, points: 0 });
  if (!gl) {
    document.getElementById("hint").textContent = "This browser has no WebGL 2, so the 3D view is not shown; everything else is.";
    canvas.style.display = "none";
    return;
  }

  // --- small vector algebra: arrays of three, matrices by column ---
  const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const length = (a) => Math.hypot(a[0], a[1], a[2]);
  const unit = (a) => { const n = length(a) || 1; return [a[0] / n, a[1] / n, a[2] / n]; };
  const product = (A, B) => {
    const C = new Float32Array(16);
    for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) for (let k = 0; k < 4; k++) C[4 * c + r] += A[4 * k + r] * B[4 * c + k];
    return C;
  };
  const lookAt = (eye, x, y, z) =>
    new Float32Array([x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, -dot(x, eye), -dot(y, eye), -dot(z, eye), 1]);
  const perspective = (tanHalf, aspect, near, far) => {
    const f = 1 / tanHalf;
    return new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, (2 * far * near) / (near - far), 0]);
  };

  // --- programs ---
  const program = (vertex, fragment) => {
    const made = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, "#version 300 es\nprecision highp float;\n" + source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(made, shader);
    }
    gl.bindAttribLocation(made, 0, "position");
    gl.bindAttribLocation(made, 1, "color");
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
    return { made, at: (name) => gl.getUniformLocation(made, name) };
  };
  const VERTEX = `in vec3 position; in vec3 color; out vec3 tint; out vec3 place;
    uniform mat4 view, lens; uniform vec3 origin, extent; uniform float size;
    void main() {
      vec4 eye = view * vec4(origin + extent * position, 1.0);
      tint = color; place = eye.xyz; gl_Position = lens * eye; gl_PointSize = size;
    }`;
  const surface = program(VERTEX, `in vec3 tint; in vec3 place; out vec4 shown; uniform int mode;
    void main() {
      vec3 n = normalize(cross(dFdx(place), dFdy(place)));
      if (dot(n, place) > 0.0) n = -n;
      float light = 0.35 + 0.65 * abs(dot(n, normalize(place)));
      vec3 base = mode == 0 ? tint : vec3(0.88);
      shown = mode == 2 ? vec4(0.5 * n + 0.5, 1.0) : vec4(base * light, 1.0);
    }`);
  const flat = program(VERTEX, `in vec3 tint; in vec3 place; out vec4 shown; uniform vec4 paint; uniform bool round;
    void main() {
      if (round && length(gl_PointCoord - 0.5) > 0.5) discard;
      shown = vec4(mix(tint, paint.rgb, paint.a), 1.0);
    }`);

  // --- buffers ---
  const bytes = (id) => Uint8Array.from(atob(document.getElementById(id).textContent.trim()), (c) => c.charCodeAt(0));
  const buffer = (kind, data) => {
    const made = gl.createBuffer();
    gl.bindBuffer(kind, made);
    gl.bufferData(kind, data, gl.STATIC_DRAW);
  };
  const layer = (positions, type, normalized, colors, indices) => {
    const vao = gl.createVertexArray();
    gl.bindVertexArray(vao);
    buffer(gl.ARRAY_BUFFER, positions);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, type, normalized, 0, 0);
    if (colors) {
      buffer(gl.ARRAY_BUFFER, colors);
      gl.enableVertexAttribArray(1);
      gl.vertexAttribPointer(1, 3, gl.UNSIGNED_BYTE, true, 0, 0);
    }
    if (indices) buffer(gl.ELEMENT_ARRAY_BUFFER, indices);
    gl.bindVertexArray(null);
    return vao;
  };
  const packed = (name, count) => {
    const data = bytes(name);
    return { positions: new Uint16Array(data.buffer, 0, 3 * count), colors: data.subarray(6 * count, 9 * count), rest: data.slice(9 * count) };
  };
  const layers = {};
  if (SCENE.mesh) {
    const data = packed("mesh-data", SCENE.mesh.vertices), indices = new Uint32Array(data.rest.buffer);
    report.triangles = indices.length / 3;
    layers.mesh = { vao: layer(data.positions, gl.UNSIGNED_SHORT, true, data.colors, indices), count: indices.length, ...SCENE.mesh };
  }
  if (SCENE.cloud) {
    const data = packed("cloud-data", SCENE.cloud.points);
    report.points = SCENE.cloud.points;
    layers.cloud = { vao: layer(data.positions, gl.UNSIGNED_SHORT, true, data.colors, null), count: SCENE.cloud.points, ...SCENE.cloud };
  }
  const lines = (places, paint, mode) => ({ vao: layer(new Float32Array(places.flat()), gl.FLOAT, false, null, null), count: places.length, paint, mode });
  const frustum = (k) => {
    const { center, x, y, z } = SCENE.keyframes[k], s = SCENE.frustum.size, [w, h] = SCENE.frustum.half;
    const corner = (a, b) => add(add(add(center, z, s), x, s * a * w), y, s * b * h);
    const c = [corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1)];
    return [0, 1, 2, 3].flatMap((n) => [center, c[n], c[n], c[(n + 1) % 4]]);
  };
  if (SCENE.trajectory.length) layers.trajectory = lines(SCENE.trajectory, [0.12, 0.44, 0.92, 1], gl.LINE_STRIP);
  if (SCENE.keyframes.length) layers.keyframes = lines(SCENE.keyframes.flatMap((_, k) => frustum(k)), [0.85, 0.45, 0.1, 1], gl.LINES);
  if (TRUTH) layers.truth = lines(TRUTH, [0.1, 0.5, 0.2, 1], gl.LINE_STRIP);

  // --- the viewer: an orbit around a target ---
  const up = unit(SCENE.up), aside = unit(cross(Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0], up)), ahead = cross(up, aside);
  let target, distance, yaw, pitch, waiting = false;
  const fromEye = (eye, at) => {
    const d = add(eye, at, -1);
    target = at; distance = Math.max(length(d), 1e-6);
    pitch = Math.asin(Math.max(-1, Math.min(1, dot(d, up) / distance)));
    yaw = Math.atan2(dot(d, aside), dot(d, ahead));
  };
  const home = () => fromEye(SCENE.eye, SCENE.target);
  const basis = () => {
    const level = add(ahead.map((v) => v * Math.cos(yaw)), aside, Math.sin(yaw));
    const z = unit(add(level.map((v) => v * Math.cos(pitch)), up, Math.sin(pitch))), x = unit(cross(up, z));
    return { x, y: cross(z, x), z };
  };
  const checked = (name) => { const box = document.getElementById("show-" + name); return box && box.checked; };
  const TAN = 0.5;

  const draw = () => {
    waiting = false;
    const ratio = window.devicePixelRatio || 1, w = Math.round(canvas.clientWidth * ratio), h = Math.round(canvas.clientHeight * ratio);
    if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
    gl.viewport(0, 0, w, h);
    gl.clearColor(0.97, 0.97, 0.98, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    const { x, y, z } = basis(), eye = add(target, z, distance);
    const view = lookAt(eye, x, y, z), lens = perspective(TAN, w / h, distance / 200, distance * 50 + 20 * SCENE.size);
    const use = (p, item) => {
      gl.useProgram(p.made);
      gl.uniformMatrix4fv(p.at("view"), false, view);
      gl.uniformMatrix4fv(p.at("lens"), false, lens);
      gl.uniform3fv(p.at("origin"), item.low || [0, 0, 0]);
      gl.uniform3fv(p.at("extent"), item.extent || [1, 1, 1]);
      gl.bindVertexArray(item.vao);
    };
    if (layers.mesh && checked("mesh")) {
      use(surface, layers.mesh);
      gl.uniform1i(surface.at("mode"), Number(document.getElementById("shading").value));
      gl.drawElements(gl.TRIANGLES, layers.mesh.count, gl.UNSIGNED_INT, 0);
    }
    if (layers.cloud && checked("cloud")) {
      use(flat, layers.cloud);
      gl.uniform4fv(flat.at("paint"), [0, 0, 0, 0]);
      gl.uniform1i(flat.at("round"), 1);
      gl.uniform1f(flat.at("size"), Number(document.getElementById("point-size").value) * ratio);
      gl.drawArrays(gl.POINTS, 0, layers.cloud.count);
    }
    for (const name of ["trajectory", "keyframes", "truth"]) {
      if (!layers[name] || !checked(name)) continue;
      use(flat, layers[name]);
      gl.uniform4fv(flat.at("paint"), layers[name].paint);
      gl.uniform1i(flat.at("round"), 0);
      gl.drawArrays(layers[name].mode, 0, layers[name].count);
    }
    gl.bindVertexArray(null);
    report.draws += 1;
    report.ready = true;
  };
  const redraw = () => { if (!waiting) { waiting = true; requestAnimationFrame(draw); } };

  // --- hands ---
  const pointers = new Map();
  const turn = (du, dv) => { yaw -= 0.006 * du; pitch = Math.max(-1.55, Math.min(1.55, pitch + 0.006 * dv)); };
  const pan = (du, dv) => {
    const { x, y } = basis(), s = (2 * TAN * distance) / canvas.clientHeight;
    target = add(add(target, x, -du * s), y, dv * s);
  };
  const zoom = (factor) => { distance = Math.max(1e-4 * SCENE.size, Math.min(50 * SCENE.size, distance * factor)); };
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("pointerdown", (event) => {
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    try { canvas.setPointerCapture(event.pointerId); } catch (error) { /* a pointer that is gone already */ }
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY], du = now[0] - before[0], dv = now[1] - before[1];
    if (pointers.size === 2) {
      const other = [...pointers.entries()].find(([id]) => id !== event.pointerId)[1];
      zoom(Math.hypot(before[0] - other[0], before[1] - other[1]) / Math.max(1, Math.hypot(now[0] - other[0], now[1] - other[1])));
      pan(du / 2, dv / 2);
    } else if (event.buttons === 2 || event.shiftKey) pan(du, dv);
    else turn(du, dv);
    pointers.set(event.pointerId, now);
    redraw();
  });
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoom(Math.exp(0.0015 * event.deltaY)); redraw(); }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const moves = { ArrowLeft: [-20, 0], ArrowRight: [20, 0], ArrowUp: [0, -20], ArrowDown: [0, 20] };
    if (moves[event.key]) turn(...moves[event.key]);
    else if (event.key === "+") zoom(0.9);
    else if (event.key === "-") zoom(1.1);
    else return;
    event.preventDefault();
    redraw();
  });
  document.getElementById("home").addEventListener("click", () => { home(); redraw(); });
  for (const input of document.querySelectorAll(".controls input, .controls select")) input.addEventListener("input", redraw);
  const slider = document.getElementById("keyframe");
  if (slider) slider.addEventListener("input", () => {
    const { center, z } = SCENE.keyframes[Number(slider.value)], reach = Math.max(0.3 * SCENE.size, 1e-6);
    fromEye(center, add(center, z, reach));
  });
  window.addEventListener("resize", redraw);
  home();
  draw();
})();
