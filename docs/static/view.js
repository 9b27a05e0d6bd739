// Draw a surface that can be turned (drag) and made larger (wheel), before the script that calls it.
// Given as base64: corners (3 int16 each), their colours (3 bytes each), triangles (3 uint32 each).
function view(corners, colours, triangles) {
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const canvas = document.createElement("canvas");
  document.currentScript.before(canvas);
  canvas.className = "view";
  canvas.width = canvas.height = 700;
  const gl = canvas.getContext("webgl2");
  if (!gl) return canvas.replaceWith("This browser has no WebGL.");
  const program = gl.createProgram();
  const shader = (kind, text) => {
    const made = gl.createShader(kind);
    gl.shaderSource(made, "#version 300 es\nprecision highp float;\n" + text);
    gl.compileShader(made);
    gl.attachShader(program, made);
  };
  shader(gl.VERTEX_SHADER, `
    layout(location = 0) in vec3 x; layout(location = 1) in vec3 c;
    uniform mat3 turn; uniform float zoom; out vec3 colour, at;
    void main() { colour = c; at = turn * x; gl_Position = vec4(zoom * at.xy, -0.3 * at.z, 1.0); }`);
  shader(gl.FRAGMENT_SHADER, `
    in vec3 colour, at; out vec4 shown;
    void main() {
      vec3 n = normalize(cross(dFdx(at), dFdy(at)));
      shown = vec4(colour * (0.55 + 0.45 * abs(n.z)), 1.0);
    }`);
  gl.linkProgram(program);
  gl.useProgram(program);
  const load = (target, data) => {
    gl.bindBuffer(target, gl.createBuffer());
    gl.bufferData(target, data, gl.STATIC_DRAW);
  };
  [[corners, gl.SHORT], [colours, gl.UNSIGNED_BYTE]].forEach(([text, kind], i) => {
    load(gl.ARRAY_BUFFER, bytes(text));
    gl.enableVertexAttribArray(i);
    gl.vertexAttribPointer(i, 3, kind, true, 0, 0);
  });
  const faces = bytes(triangles);
  load(gl.ELEMENT_ARRAY_BUFFER, faces);
  gl.enable(gl.DEPTH_TEST);
  gl.clearColor(1, 1, 1, 1);
  let around = 0.6, up = 0.5, zoom = 0.8;
  const draw = () => {
    const [s, c, p, q] = [Math.sin(around), Math.cos(around), Math.sin(up), Math.cos(up)];
    const turn = [c, p * s, -q * s, -s, p * c, -q * c, 0, q, p]; // by columns; z is upwards
    gl.uniformMatrix3fv(gl.getUniformLocation(program, "turn"), false, turn);
    gl.uniform1f(gl.getUniformLocation(program, "zoom"), zoom);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.drawElements(gl.TRIANGLES, faces.length / 4, gl.UNSIGNED_INT, 0);
  };
  canvas.onpointermove = (event) => {
    if (!event.buttons) return;
    around += 0.01 * event.movementX;
    up += 0.01 * event.movementY;
    draw();
  };
  canvas.onwheel = (event) => {
    event.preventDefault();
    zoom *= Math.exp(-0.001 * event.deltaY);
    draw();
  };
  draw();
}
