"""Modes added up in JavaScript, as the panels do, beside a vertex shader that reads a texture.

    python benchmarks/deform.py [VERTICES ...] [--modes 10]

at 30,000 and 100,000 vertices if none are given, in Chromium with a software renderer.  A step of a
slider moves all modes: *script* sums them, makes the exact normals again (those of ``surface.js``)
and uploads both; *shader* reads displacement and first-order change of the normal, two texels a
mode, *place alone* only the displacement, which leaves the normals wrong.  A turn draws what is
there once more: the shader adds up the modes for it again.  Milliseconds, the least and the median
of ten in turn, with what the page waits for until a pixel can be read.
"""

import argparse
import sys
from pathlib import Path

import chromium
from playwright.sync_api import sync_playwright

import s4a.show

SIZES = (30_000, 100_000)
SURFACE = Path(s4a.show.__file__).parent / "esm" / "surface.js"
PAGE = """
const canvas = document.createElement("canvas");
Object.assign(canvas, { width: 900, height: 600 });
const gl = canvas.getContext("webgl2", { antialias: false });
const WIDE = 4096;
const LIT = `#version 300 es
precision highp float;
in vec3 n;
out vec4 pixel;
void main() { pixel = vec4(vec3(0.5 + 0.5 * normalize(n).z), 1.0); }`;
const STILL = `#version 300 es
in vec3 position, normal;
out vec3 n;
void main() { n = normal; gl_Position = vec4(0.6 * position, 1.0); }`;
const moving = (modes, texels) => `#version 300 es
precision highp float;
precision highp sampler2D;
in vec3 position, normal;
uniform sampler2D table;
uniform float scores[${modes}];
out vec3 n;
vec3 texel(int i) { return texelFetch(table, ivec2(i % ${WIDE}, i / ${WIDE}), 0).xyz; }
void main() {
  vec3 p = position, t = normal;
  for (int k = 0; k < ${modes}; k++) {
    int at = (gl_VertexID * ${modes} + k) * 2;
    p += scores[k] * texel(at);
    ${texels > 1 ? "t += scores[k] * texel(at + 1);" : ""}
  }
  n = normalize(t);
  gl_Position = vec4(0.6 * p, 1.0);
}`;

function program(vertex) {
  const it = gl.createProgram();
  gl.attachShader(it, shader(gl, gl.VERTEX_SHADER, vertex));
  gl.attachShader(it, shader(gl, gl.FRAGMENT_SHADER, LIT));
  ["position", "normal"].forEach((name, i) => gl.bindAttribLocation(it, i, name));
  gl.linkProgram(it);
  if (!gl.getProgramParameter(it, gl.LINK_STATUS)) throw gl.getProgramInfoLog(it);
  return it;
}

function sphere(vertices) {
  const rows = Math.round(Math.sqrt(vertices)), P = [], T = [];
  for (let i = 0; i < rows; i++) for (let j = 0; j < rows; j++) {
    const a = (Math.PI * i) / (rows - 1), b = (2 * Math.PI * j) / rows;
    P.push(Math.sin(a) * Math.cos(b), Math.sin(a) * Math.sin(b), Math.cos(a));
    const here = i * rows + j, next = i * rows + ((j + 1) % rows);
    if (i < rows - 1) T.push(here, here + rows, next, next, here + rows, next + rows);
  }
  return [new Float32Array(P), new Uint32Array(T)];
}

function measured(vertices, modes) {
  const [P, T] = sphere(vertices), count = P.length / 3;
  const steps = [...Array(modes).keys()].map((k) => P.map((x) => 0.02 * Math.sin(3 * (k + 1) * x)));
  const rows = Math.ceil((2 * count * modes) / WIDE), table = new Float32Array(4 * WIDE * rows);
  for (let v = 0; v < count; v++) for (let k = 0; k < modes; k++) for (let x = 0; x < 3; x++) {
    const at = 4 * 2 * (v * modes + k) + x;
    table[at] = table[at + 4] = steps[k][3 * v + x];
  }
  const buffers = [gl.createBuffer(), gl.createBuffer()], N = normalsOf(P, T), moved = P.slice();
  const upload = (...arrays) => arrays.forEach((data, i) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers[i]);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(i);
    gl.vertexAttribPointer(i, 3, gl.FLOAT, false, 0, 0);
  });
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, T, gl.STATIC_DRAW);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, WIDE, rows, 0, gl.RGBA, gl.FLOAT, table);
  for (const name of ["TEXTURE_MIN_FILTER", "TEXTURE_MAG_FILTER"])
    gl.texParameteri(gl.TEXTURE_2D, gl[name], gl.NEAREST);
  gl.enable(gl.DEPTH_TEST);
  const still = program(STILL), both = program(moving(modes, 2)), place = program(moving(modes, 1));
  const draw = (by, scores) => {
    gl.useProgram(by);
    if (scores) gl.uniform1fv(gl.getUniformLocation(by, "scores"), scores);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.drawElements(gl.TRIANGLES, T.length, gl.UNSIGNED_INT, 0);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  };
  const ways = {
    script: (scores) => {
      moved.set(P);
      steps.forEach((step, k) => {
        for (let i = 0; i < moved.length; i++) moved[i] += scores[k] * step[i];
      });
      upload(moved, normalsOf(moved, T, N));
      draw(still);
    },
    "script, a turn": () => draw(still),
    shader: (scores) => draw(both, scores),
    "place alone": (scores) => draw(place, scores),
  };
  const spent = Object.fromEntries(Object.keys(ways).map((name) => [name, []]));
  for (let round = 0; round < 12; round++) {
    const scores = Float32Array.from({ length: modes }, (_, k) => Math.sin(round + k));
    for (const name in ways) {
      const begin = performance.now();
      ways[name](scores);
      if (round > 1) spent[name].push(performance.now() - begin);
    }
  }
  return Object.entries(spent).map(([name, all]) => {
    all.sort((a, b) => a - b);
    return [name, all[0], all[5]];
  });
}
"""


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("vertices", nargs="*", type=int)
    parser.add_argument("--modes", type=int, default=10)
    said = parser.parse_args()
    sys.stdout.write("| vertices | way | least (ms) | median (ms) |\n|---|---|---|---|\n")
    with sync_playwright() as driver:
        browser = chromium.launched(driver)
        for size in said.vertices or SIZES:
            page = browser.new_page()
            page.add_script_tag(content=SURFACE.read_text(encoding="utf-8") + PAGE)
            for way, least, median in page.evaluate(f"measured({size}, {said.modes})"):
                sys.stdout.write(f"| {size:,} | {way} | {least:.0f} | {median:.0f} |\n")
            page.close()
        browser.close()


if __name__ == "__main__":
    main()
