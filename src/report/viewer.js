// Points to turn round by hand, in `root`; gives back what shows other points in their place.
const viewer = (root, data) => {
  const canvas = root.querySelector("canvas"), select = root.querySelector("select");
  const height = root.querySelector("input");
  const gl = canvas.getContext("webgl", { preserveDrawingBuffer: true });
  if (!gl) {
    root.innerHTML = "<p>This browser shows no 3D (WebGL is off); the pictures below are the same.</p>";
    return { show() {} };
  }
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const shader = (kind, source) => {
    const s = gl.createShader(kind);
    gl.shaderSource(s, source);
    gl.compileShader(s);
    return s;
  };
  const program = gl.createProgram();
  gl.attachShader(program, shader(gl.VERTEX_SHADER,
    "attribute vec3 p;attribute vec3 c;uniform mat3 turn;uniform vec3 size,pan;uniform float zoom,aspect,dot,lift;varying vec3 v;" +
    "void main(){vec3 q=turn*((p-.5)*size)*zoom+pan;gl_Position=vec4(q.x/aspect,q.y,q.z*.1-lift,1.);gl_PointSize=dot;v=c;}"));
  gl.attachShader(program, shader(gl.FRAGMENT_SHADER,
    "precision mediump float;varying vec3 v;void main(){gl_FragColor=vec4(v,1.);}"));
  gl.linkProgram(program);
  gl.useProgram(program);
  const uniform = (name) => gl.getUniformLocation(program, name);
  const buffer = (content) => {
    const b = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, b);
    gl.bufferData(gl.ARRAY_BUFFER, content, gl.STATIC_DRAW);
    return b;
  };
  const placed = ({ at, size, from, to, values }) => {
    const content = bytes(at);
    return { buffer: buffer(content), count: content.length / 6, size, from, to, at: new Uint16Array(content.buffer),
      values: (values || []).map((one) => ({ ...one, numbers: new Float32Array(bytes(one.numbers).buffer) })) };
  };
  // Three edges of the box, from its least corner.
  const edge = [0, 1, 2].flatMap((axis) => [0, 0, 0, ...[0, 1, 2].map((i) => (i === axis ? 65535 : 0))]);
  const tint = [[190, 30, 30], [20, 130, 20], [40, 60, 200]];
  const axes = { buffer: buffer(new Uint16Array(edge)), count: 6 };
  const axisColors = buffer(new Uint8Array(tint.flatMap((c) => [...c, ...c])));
  const added = (name, kind) => root.appendChild(Object.assign(document.createElement(name), { className: kind }));
  const labels = tint.map((color) => {
    const label = added("span", "axis");
    label.style.color = `rgb(${color})`;
    return label;
  });
  const mark = added("span", "mark"), scale = added("div", "scale"), found = added("output", "found");
  let picked = null;
  const under = data.under && { ...placed(data.under), colors: buffer(bytes(data.under.colors)), triangles: data.under.triangles };
  let places = [], modes = [];
  const take = (data) => {
    [...places, ...modes].forEach((old) => gl.deleteBuffer(old.buffer));
    places = data.places.map(placed);
    modes = data.modes.map((mode) => ({ ...mode, buffer: buffer(bytes(mode.colors)) }));
    picked = null;
    if (!select.length) modes.forEach((mode, i) => select.add(new Option(mode.name, i)));
  };
  take(data);
  // A unit is half the height: where the canvas is narrower than high, the points must fit its width.
  const fit = Math.min(1, canvas.clientWidth / canvas.clientHeight);
  let [yaw, pitch, zoom, panX, panY] = [data.yaw, data.pitch, 1.5 * fit, 0, 0];
  height.value = pitch;
  // Where a point of the box is on the canvas, px, and its depth, as the vertex shader has it.
  const project = (p, size) => {
    const [a, b, c] = p.map((share, i) => (share - 0.5) * size[i]);
    const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    const x = (cy * a - sy * b) * zoom + panX, y = (sp * (sy * a + cy * b) + cp * c) * zoom + panY;
    const [w, h] = [canvas.clientWidth, canvas.clientHeight];
    return [(x * h + w) / 2, ((1 - y) * h) / 2, cp * (sy * a + cy * b) - sp * c];
  };
  const short = (x) => String(Number(x.toPrecision(4)));
  const put_at = (element, [x, y]) => {
    const inside = x >= 0 && y >= 0 && x <= canvas.clientWidth && y <= canvas.clientHeight;
    element.style.display = inside ? "block" : "none";
    element.style.left = `${canvas.offsetLeft + x}px`;
    element.style.top = `${canvas.offsetTop + y}px`;
  };
  const annotate = (mode, box) => {
    labels.forEach((label, i) => {
      label.style.display = "none";
      if (!box) return;
      label.textContent = `${"xyz"[i]}: ${short(box.from[i])} to ${short(box.to[i])} mm`;
      put_at(label, project([0, 1, 2].map((j) => (j === i ? 1 : 0)), box.size));
    });
    scale.style.display = mode && mode.bar ? "block" : "none";
    if (mode && mode.bar) {
      const { low, high, unit, colors } = mode.bar;
      scale.textContent = `${short(low)} ${unit} to ${short(high)} ${unit}`;
      scale.style.background = `linear-gradient(to right, ${colors.map((c) => `rgb(${c})`).join(",")})`;
    }
    const place = picked && places[picked.places];
    mark.style.display = "none";
    found.textContent = place ? picked.text : "";
    if (place) put_at(mark, project(picked.at, place.size));
  };
  // Names the point nearest to the eye within 12 px.
  const pick = (x, y) => {
    const mode = modes[select.value], place = mode && places[mode.places];
    picked = null;
    let nearest = Infinity;
    for (let i = 0; place && i < place.count; i++) {
      const at = [0, 1, 2].map((j) => place.at[3 * i + j] / 65535);
      const [px, py, depth] = project(at, place.size);
      if (Math.hypot(px - x, py - y) > 12 || depth >= nearest) continue;
      nearest = depth;
      const mm = at.map((share, j) => short(place.from[j] + share * (place.to[j] - place.from[j])));
      const values = place.values.map((one) => `${one.name} ${short(one.numbers[i])}${one.unit && ` ${one.unit}`}`);
      picked = { at, places: mode.places, text: [`x, y, z: ${mm.join(", ")} mm`, ...values].join("; ") };
    }
    draw();
  };
  const draw = () => {
    const ratio = window.devicePixelRatio || 1;
    canvas.width = canvas.clientWidth * ratio;
    canvas.height = canvas.clientHeight * ratio;
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0.957, 0.965, 0.973, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    // Columns; z of the part is up, and depth grows away from the eye.
    gl.uniformMatrix3fv(uniform("turn"), false, [cy, sp * sy, cp * sy, -sy, sp * cy, cp * cy, 0, cp, -sp]);
    gl.uniform3f(uniform("pan"), panX, panY, 0);
    gl.uniform1f(uniform("zoom"), zoom);
    gl.uniform1f(uniform("aspect"), canvas.width / canvas.height);
    const attribute = (name, from, kind, bytes) => {
      const at = gl.getAttribLocation(program, name);
      gl.bindBuffer(gl.ARRAY_BUFFER, from);
      gl.enableVertexAttribArray(at);
      gl.vertexAttribPointer(at, 3, kind, true, bytes, 0);
    };
    const put = (at, colors, kind, dot, lift) => {
      gl.uniform1f(uniform("dot"), dot);
      gl.uniform1f(uniform("lift"), lift);
      gl.uniform3fv(uniform("size"), at.size);
      attribute("p", at.buffer, gl.UNSIGNED_SHORT, 6);
      attribute("c", colors, gl.UNSIGNED_BYTE, 3);
      gl.drawArrays(kind, 0, at.count);
    };
    const dot = Math.max(1.5, 1.6 * ratio * Math.sqrt(zoom));
    if (under) put(under, under.colors, under.triangles ? gl.TRIANGLES : gl.POINTS, 1.6 * dot, 0);
    const mode = modes[select.value];
    // Points on the surface under them are drawn a little nearer.
    if (mode) put(places[mode.places], mode.buffer, gl.POINTS, under ? 2 * dot : dot * (mode.places ? 1.6 : 1), under ? 0.003 : 0);
    const box = under || (mode && places[mode.places]);
    if (box) put({ ...axes, size: box.size }, axisColors, gl.LINES, 1, 0.002);
    root.querySelector("p").textContent = mode ? mode.caption : "";
    annotate(mode, box);
    // For tests and for those who want the same view again.
    root.dataset.view = JSON.stringify([yaw, pitch, zoom, panX, panY]);
  };
  const turn = (dx, dy) => {
    yaw += dx;
    pitch = Math.min(1.6, Math.max(-1.6, pitch + dy));
    height.value = pitch;
  };
  const move = (dx, dy) => {
    panX += (2 * dx) / canvas.clientHeight;
    panY -= (2 * dy) / canvas.clientHeight;
  };
  // Zooms so that what is at (x, y) of the canvas, px, stays there.
  const zoomAt = (factor, x, y) => {
    const atX = (2 * x - canvas.clientWidth) / canvas.clientHeight, atY = 1 - (2 * y) / canvas.clientHeight;
    zoom *= factor;
    panX = atX + (panX - atX) * factor;
    panY = atY + (panY - atY) * factor;
  };
  // Where each finger, or the mouse while pressed, is. One finger up and down scrolls the
  // page (touch-action in report.css): the browser then takes it back by pointercancel.
  const pressed = new Map();
  let start = [0, 0];
  const between = () => {
    const [a, b] = [...pressed.values()];
    return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, apart: Math.hypot(a.x - b.x, a.y - b.y) };
  };
  canvas.onpointerdown = (e) => {
    canvas.setPointerCapture(e.pointerId);
    pressed.set(e.pointerId, { x: e.offsetX, y: e.offsetY });
    start = [e.offsetX, e.offsetY];
  };
  canvas.onpointermove = (e) => {
    const last = pressed.get(e.pointerId);
    if (!last) return;
    const before = pressed.size === 2 && between();
    const [dx, dy] = [e.offsetX - last.x, e.offsetY - last.y];
    pressed.set(e.pointerId, { x: e.offsetX, y: e.offsetY });
    if (before) {
      const now = between();
      move(now.x - before.x, now.y - before.y);
      if (before.apart > 0 && now.apart > 0) zoomAt(now.apart / before.apart, now.x, now.y);
    } else if (pressed.size === 1) {
      if (e.buttons > 1 || e.shiftKey) move(dx, dy);
      else turn(dx * 0.008, e.pointerType === "touch" ? 0 : dy * 0.008);
    }
    draw();
  };
  canvas.onpointercancel = (e) => pressed.delete(e.pointerId);
  canvas.onpointerup = (e) => {
    const alone = pressed.size === 1;
    pressed.delete(e.pointerId);
    // A press that moved turned the view.
    if (alone && Math.hypot(e.offsetX - start[0], e.offsetY - start[1]) < 4) pick(e.offsetX, e.offsetY);
  };
  canvas.onkeydown = (e) => {
    const by = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[e.key];
    if (by) turn(...by);
    else if (e.key === "+" || e.key === "-") zoom *= e.key === "+" ? 1.2 : 1 / 1.2;
    else return;
    e.preventDefault();
    draw();
  };
  height.oninput = () => {
    pitch = Number(height.value);
    draw();
  };
  canvas.oncontextmenu = (e) => e.preventDefault();
  canvas.onwheel = (e) => {
    e.preventDefault();
    zoomAt(Math.exp(-e.deltaY * 0.001), e.offsetX, e.offsetY);
    draw();
  };
  select.onchange = draw;
  window.addEventListener("resize", draw);
  draw();
  return {
    show(data) {
      take(data);
      draw();
    },
  };
};
