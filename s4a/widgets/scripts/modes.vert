// Vertices of the mean shape plus the sum of score times mode of variation (6.1), and their normals.
// A texel of the table holds, for a vertex and a mode, the displacement at one standard deviation,
// and the change of the normal as three 8-bit numbers in one float.
#define PHONG
attribute float row;
uniform sampler2D table;
uniform vec2 size;
uniform float scores[SLOTS];
uniform float bends[SLOTS];
uniform float limit;
varying vec3 vViewPosition;
varying vec3 vNormal;
varying float vAlong;

vec3 unpacked(float number) {
  return vec3(mod(number, 256.0), mod(floor(number / 256.0), 256.0), floor(number / 65536.0));
}

void main() {
  vec3 moved = position;
  vec3 bent = normal;
  for (int mode = 0; mode < MODES; mode++) {
    if (scores[mode] == 0.0) continue;
    float texel = row * float(MODES) + float(mode); // size.x is a power of two: exact
    vec2 position_in_table = vec2(mod(texel, size.x), floor(texel / size.x)) + 0.5;
    vec4 change = texture2D(table, position_in_table / size);
    moved += scores[mode] * change.xyz;
    bent += scores[mode] * bends[mode] * (unpacked(change.w) - 127.0) / 127.0;
  }
  vAlong = dot(moved - position, normal) / limit;
  vNormal = normalize(normalMatrix * bent);
  vec4 mvPosition = modelViewMatrix * vec4(moved, 1.0);
  vViewPosition = -mvPosition.xyz;
  gl_Position = projectionMatrix * mvPosition;
}
