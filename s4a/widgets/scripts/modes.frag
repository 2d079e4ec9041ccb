// Lighting of a surface coloured by its displacement along the mean's normals.
#define PHONG
uniform vec3 diffuse;
uniform vec3 emissive;
uniform vec3 specular;
uniform float shininess;
uniform float opacity;
uniform float colored;
uniform vec3 compressed;
uniform vec3 narrowed;
uniform vec3 still;
uniform vec3 widened;
uniform vec3 expanded;
varying float vAlong;
#include <common>
#include <bsdfs>
#include <lights_pars_begin>
#include <lights_phong_pars_fragment>

vec3 hue(float share) {
  float t = 2.0 * clamp(abs(share), 0.0, 1.0);
  vec3 middle = share < 0.0 ? narrowed : widened;
  vec3 full = share < 0.0 ? compressed : expanded;
  return t < 1.0 ? mix(still, middle, t) : mix(middle, full, t - 1.0);
}

void main() {
  vec3 along = hue(vAlong);
  vec4 diffuseColor = vec4(mix(diffuse, along, colored), opacity);
  ReflectedLight reflectedLight = ReflectedLight(vec3(0.0), vec3(0.0), vec3(0.0), vec3(0.0));
  float specularStrength = 1.0;
  #include <normal_fragment_begin>
  #include <lights_phong_fragment>
  #include <lights_fragment_begin>
  #include <lights_fragment_end>
  vec3 light = reflectedLight.directDiffuse + reflectedLight.indirectDiffuse;
  gl_FragColor = vec4(light + reflectedLight.directSpecular + emissive, diffuseColor.a);
}
