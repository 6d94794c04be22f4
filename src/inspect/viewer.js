(() => {
  const root = document.getElementById("viewer");
  const data = JSON.parse(document.getElementById("viewer-data").textContent);
  const canvas = root.querySelector("canvas"), select = root.querySelector("select");
  const gl = canvas.getContext("webgl", { preserveDrawingBuffer: true });
  if (!gl) {
    root.innerHTML = "<p>This browser shows no 3D (WebGL is off); the pictures below are the same.</p>";
    return;
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
    "attribute vec3 p;attribute vec3 c;uniform mat3 turn;uniform vec3 size,pan;uniform float zoom,aspect,dot;varying vec3 v;" +
    "void main(){vec3 q=turn*((p-.5)*size)*zoom+pan;gl_Position=vec4(q.x/aspect,q.y,q.z*.1,1.);gl_PointSize=dot;v=c;}"));
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
  const places = data.places.map((text) => {
    const content = bytes(text);
    return { buffer: buffer(content), count: content.length / 6 };
  });
  const modes = data.modes.map((mode) => ({ ...mode, buffer: buffer(bytes(mode.colors)) }));
  modes.forEach((mode, i) => select.add(new Option(mode.name, i)));
  let [yaw, pitch, zoom, panX, panY] = [data.yaw, data.pitch, 1.5, 0, 0];
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
    gl.uniform3fv(uniform("size"), data.size);
    gl.uniform3f(uniform("pan"), panX, panY, 0);
    gl.uniform1f(uniform("zoom"), zoom);
    gl.uniform1f(uniform("aspect"), canvas.width / canvas.height);
    const mode = modes[select.value];
    gl.uniform1f(uniform("dot"), Math.max(1.5, 1.6 * ratio * Math.sqrt(zoom)) * (mode.places ? 1.6 : 1));
    const at = places[mode.places];
    const [p, c] = [gl.getAttribLocation(program, "p"), gl.getAttribLocation(program, "c")];
    gl.bindBuffer(gl.ARRAY_BUFFER, at.buffer);
    gl.enableVertexAttribArray(p);
    gl.vertexAttribPointer(p, 3, gl.UNSIGNED_SHORT, true, 6, 0);
    gl.bindBuffer(gl.ARRAY_BUFFER, mode.buffer);
    gl.enableVertexAttribArray(c);
    gl.vertexAttribPointer(c, 3, gl.UNSIGNED_BYTE, true, 3, 0);
    gl.drawArrays(gl.POINTS, 0, at.count);
    root.querySelector("p").textContent = mode.caption;
  };
  canvas.onpointermove = (e) => {
    if (!e.buttons) return;
    if (e.buttons > 1 || e.shiftKey) {
      panX += (2 * e.movementX) / canvas.clientHeight;
      panY -= (2 * e.movementY) / canvas.clientHeight;
    } else {
      yaw += e.movementX * 0.008;
      pitch = Math.min(1.6, Math.max(-1.6, pitch + e.movementY * 0.008));
    }
    draw();
  };
  canvas.onpointerdown = (e) => canvas.setPointerCapture(e.pointerId);
  canvas.oncontextmenu = (e) => e.preventDefault();
  canvas.onwheel = (e) => {
    e.preventDefault();
    zoom *= Math.exp(-e.deltaY * 0.001);
    draw();
  };
  select.onchange = draw;
  window.addEventListener("resize", draw);
  draw();
})();
