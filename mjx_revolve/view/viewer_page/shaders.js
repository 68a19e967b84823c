// Shaders. World frame with z up, metres; colours are linear until `finish`.
//
// Quantities of the simulation are drawn as they are: the surface has the height of the world's waves, dust
// drifts with the current and circles with the waves. Ripples (normals only), caustics, shafts of
// light and haze are decoration: they give scale and depth and say nothing about the simulation.

const glsl = (color) => `linear(vec3(${color.map((x) => x.toFixed(4)).join()}))`;

// Of every shader, with what vertices tell fragments: place [m], normal and colour.
const UNIFORMS = /* glsl */ `
precision highp float;
varying vec3 vPlace, vNormal, vTint;
uniform vec3 uTarget;     // what is looked at, m
uniform float uTime;      // s
uniform vec3 uEye;        // m
uniform float uSurface;   // z of the still surface, m
uniform vec3 uSun;        // unit vector towards the sun, seen under water
uniform float uSize;      // body length, m: decoration scales with it
uniform float uHaze;      // 1; less where one looks from far away, or nothing would be seen
uniform vec4 uWaves[MAX_WAVES];  // kx, ky [rad/m], amplitude [m], phase now [rad]
uniform float uFade[MAX_WAVES];  // k: orbits fade with e^(k z)

// Slope (xy) and height (z) of the world's waves, without those that are finer than this spacing.
vec3 sea(vec2 p, float spacing) {
  vec3 sum = vec3(0.0);
  for (int i = 0; i < MAX_WAVES; i++) {
    vec4 w = uWaves[i];
    float phase = dot(w.xy, p) + w.w, seen = 1.0 - smoothstep(0.6, 2.5, spacing * length(w.xy));
    sum += w.z * seen * vec3(-w.xy * sin(phase), cos(phase));
  }
  return sum;
}
`;

// Of every fragment shader: light, water, air.
const LIGHT = /* glsl */ `
// Light in a clear lake: red is lost first.
#define ABSORB (uHaze * vec3(0.34, 0.105, 0.085))  // 1/m
vec3 linear(vec3 c) { return pow(c, vec3(2.2)); }
#define DEEP ${glsl(PALETTE.water_down)}
#define MID ${glsl(PALETTE.water_ahead)}
#define BRIGHT ${glsl(PALETTE.water_up)}

float hash(vec2 p) { return fract(sin(dot(p, vec2(12.9898, 78.233))) * 43758.5453); }

float noise(vec2 p) {
  vec2 i = floor(p), f = fract(p);
  f = f * f * (3.0 - 2.0 * f);
  return mix(mix(hash(i), hash(i + vec2(1, 0)), f.x),
             mix(hash(i + vec2(0, 1)), hash(i + vec2(1, 1)), f.x), f.y);
}

float fbm(vec2 p) {
  float sum = 0.0, weight = 0.5;
  for (int i = 0; i < 4; i++) {
    sum += weight * noise(p);
    p = mat2(1.6, 1.2, -1.2, 1.6) * p + 3.7;
    weight *= 0.5;
  }
  return sum;
}

vec3 filmic(vec3 c) {  // Narkowicz's fit of ACES
  return c * (2.51 * c + 0.03) / (c * (2.43 * c + 0.59) + 0.14);
}

// To the screen's colours. Bending each channel by itself shifts hues; bending the brightest and
// letting the others follow never whitens: some of both.
vec3 finish(vec3 c) {
  float most = max(max(c.r, c.g), max(c.b, 1e-5));
  vec3 kept = c * (filmic(vec3(most)).x / most);
  c = pow(clamp(mix(kept, filmic(c), 0.6), 0.0, 1.0), vec3(1.0 / 2.2));
  return c + (hash(gl_FragCoord.xy) - 0.5) / 255.0;  // hides the bands of slow gradients
}

float daylight(float depth) { return 0.34 + 0.66 * exp(-0.09 * max(depth, 0.0)); }

vec3 sky(vec3 d) {
  vec3 c = mix(${glsl(PALETTE.sky_low)}, ${glsl(PALETTE.sky_high)}, pow(clamp(d.z, 0.0, 1.0), 0.55));
  if (d.z > 0.02) {
    float cloud = fbm(d.xy / (d.z + 0.15) * 1.3 + 4.0);
    c = mix(c, vec3(0.95, 0.97, 1.0), 0.75 * smoothstep(0.48, 0.80, cloud) * smoothstep(0.02, 0.3, d.z));
  }
  float near = max(dot(d, normalize(vec3(uSun.xy * 1.33, uSun.z))), 0.0);
  return c + vec3(1.0, 0.93, 0.78) * (9.0 * pow(near, 1800.0) + 0.35 * pow(near, 24.0));
}

// What open water sends towards the eye from a direction.
vec3 waterBody(vec3 d) {
  vec3 c = mix(DEEP, MID, smoothstep(-0.95, 0.15, d.z));
  c = mix(c, BRIGHT, 0.85 * pow(smoothstep(-0.10, 1.0, d.z), 1.7));
  float ahead = max(dot(d, uSun), 0.0);
  c += vec3(0.10, 0.22, 0.22) * pow(ahead, 5.0);
  return c * daylight(uSurface - uEye.z);
}

// A colour at a place, seen from the eye through water and air.
vec3 throughWater(vec3 c, vec3 place) {
  vec3 ray = place - uEye;
  float far = length(ray);
  vec3 d = ray / max(far, 1e-6);
  float eye = uEye.z - uSurface, end = place.z - uSurface;
  float wet = 1.0;
  if (eye > 0.0) wet = end < 0.0 ? -end / (eye - end) : 0.0;
  else if (end > 0.0) wet = eye / (eye - end);
  vec3 left = exp(-ABSORB * wet * far);
  c = c * left + waterBody(d) * (1.0 - left.g);
  return mix(sky(vec3(d.xy, 0.03)), c, exp(-0.004 * (1.0 - wet) * far));
}

// A net of bright lines where a rippled surface focuses the sun.
float caustic(vec2 p) {
  float light = 1.0;
  for (int i = 0; i < 3; i++) {
    float s = float(i);
    vec2 q = mat2(0.80, 0.60, -0.60, 0.80) * p * (1.0 + 0.35 * s) + s * 7.3;
    q += 0.75 * vec2(sin(q.y * 1.1 + uTime * 0.9 + s), cos(q.x * 0.9 - uTime * 0.8 + 2.0 * s));
    q += 0.35 * vec2(cos(q.y * 2.3 - uTime * 1.1), sin(q.x * 2.1 + uTime * 1.0));
    light = min(light, abs(sin(q.x) + sin(q.y)) * 0.7 + 0.05);
  }
  return pow(1.0 - light, 5.0);
}

float causticAt(vec3 place) {
  float below = uSurface - place.z;
  vec2 at = place.xy + uSun.xy / uSun.z * below;
  return caustic(at * 2.2 / uSize * 0.5) * smoothstep(0.0, 0.3 * uSize, below) * exp(-0.12 * max(below, 0.0));
}

// Sunlight that ripples gather into shafts, summed along the line of sight: towards a direction, as
// far as something is.
vec3 shafts(vec3 d, float far) {
  float sum = 0.0, step = min(1.2 * uSize, far / 7.0), s = step * (0.5 + 0.5 * hash(gl_FragCoord.xy));
  for (int i = 0; i < 7; i++) {
    vec3 p = uEye + d * s;
    float below = uSurface - p.z;
    if (below > 0.0) {
      vec2 q = (p.xy + uSun.xy / uSun.z * below) / uSize;
      float a = sin(q.x * 1.7 + q.y * 0.6 + 0.5 * uTime + 1.4 * sin(q.y * 0.9 - 0.31 * uTime));
      float b = sin(q.y * 1.9 - q.x * 0.8 - 0.4 * uTime + 1.3 * sin(q.x * 1.1 + 0.27 * uTime));
      float c = sin(q.x * 4.1 - q.y * 3.3 + 0.8 * uTime);
      sum += pow(0.5 + 0.25 * (a + b), 3.0) * (0.75 + 0.25 * c) * exp(-0.22 * below) * exp(-0.10 * s);
    }
    s += step;
  }
  float towards = 0.15 + 0.85 * smoothstep(-0.6, 0.4, d.z);
  return vec3(0.19, 0.44, 0.47) * (sum / 7.0) * (step / (1.2 * uSize)) * towards;
}

uniform sampler2D uShadow;
uniform mat4 uShadowMatrix;

// Share of sunlight that the robot leaves; blur in texels.
float sunlit(vec3 place, vec3 normal, float blur) {
  vec3 at = 0.5 + 0.5 * (uShadowMatrix * vec4(place + normal * 0.012 * uSize, 1.0)).xyz;
  if (any(lessThan(at.xy, vec2(0.0))) || any(greaterThan(at.xy, vec2(1.0)))) return 1.0;
  float lit = 0.0, turn = 6.2832 * hash(gl_FragCoord.xy);
  for (int i = 0; i < 12; i++) {
    float r = sqrt((float(i) + 0.5) / 12.0), a = 2.4 * float(i) + turn;
    vec4 t = texture2D(uShadow, at.xy + r * blur / 1024.0 * vec2(cos(a), sin(a)));
    float depth = dot(t.rgb, vec3(1.0, 1.0 / 255.0, 1.0 / 65025.0));
    lit += depth > 0.999 || at.z < depth + 0.003 ? 1.0 : 0.0;
  }
  return lit / 12.0;
}
`;

// Fills the screen behind everything.
const BACKGROUND = {
  vertex: /* glsl */ `
uniform mat4 uUnproject;
void main() {
  vec4 far = uUnproject * vec4(position.xy, 1.0, 1.0);
  vPlace = far.xyz / far.w;
  gl_Position = vec4(position.xy, 1.0, 1.0);
}`,
  fragment: /* glsl */ `
void main() {
  vec3 d = normalize(vPlace - uEye), c;
  if (uEye.z < uSurface) {
    c = waterBody(d) + shafts(d, 100.0);
  } else {
    c = d.z > 0.0 ? sky(d) : waterBody(refract(d, vec3(0.0, 0.0, 1.0), 0.752));
    c = mix(sky(vec3(d.xy, 0.03)), c, smoothstep(0.0, 0.02, abs(d.z)));
  }
  gl_FragColor = vec4(finish(c), 1.0);
}`,
};

// Where a point of a robot is: moved by one of the robot's bodies.
const BENT = /* glsl */ `
uniform vec4 uBodies[2 * BODIES];  // place [m] and quaternion x, y, z, w of each
attribute float body;
attribute vec3 tint;
vec3 turned(vec4 q, vec3 v) { return v + 2.0 * cross(q.xyz, cross(q.xyz, v) + q.w * v); }
vec3 placed() { int k = 2 * int(body + 0.5); return uBodies[k].xyz + turned(uBodies[k + 1], position); }
`;

const ROBOT = {
  vertex: BENT + /* glsl */ `
void main() {
  vPlace = placed();
  vNormal = turned(uBodies[2 * int(body + 0.5) + 1], normal);
  vTint = tint;
  gl_Position = projectionMatrix * viewMatrix * vec4(vPlace, 1.0);
}`,
  fragment: /* glsl */ `
uniform float uSeen;  // 0 not there, 1 whole: robots appear and vanish by dissolving
uniform float uGlow;  // of a robot that is pointed at
uniform float uLine;  // 1 for the dark lines along edges
void main() {
  if (hash(gl_FragCoord.xy * 0.37) >= uSeen) discard;
  vec3 n = normalize(vNormal), v = normalize(uEye - vPlace), albedo = 0.02 + 0.98 * linear(vTint);
  float below = uSurface - vPlace.z, under = smoothstep(-0.01, 0.01, below), day = daylight(below);
  if (uLine > 0.5) {
    vec3 c = throughWater(albedo * 0.10 * day, vPlace);
    gl_FragColor = vec4(finish(c), 0.55);
    return;
  }
  float facing = dot(n, uSun), lit = facing > 0.0 ? sunlit(vPlace, n, 2.2) : 0.0;
  float sun = max(facing, 0.0) * lit;
  vec3 high = mix(vec3(0.62, 0.72, 0.80), vec3(0.34, 0.62, 0.66), under);
  vec3 low = mix(vec3(0.20, 0.24, 0.26), vec3(0.05, 0.14, 0.19), under);
  vec3 light = mix(low, high, 0.5 + 0.5 * n.z);
  light += mix(vec3(1.5, 1.42, 1.25), vec3(0.95, 1.10, 1.05), under)
    * sun * mix(1.0, 0.72 + 1.25 * causticAt(vPlace), under);
  light += 0.20 * max(dot(n, v), 0.0);  // a lamp at the camera keeps shadows readable
  vec3 h = normalize(uSun + v);
  vec3 c = albedo * light * day;
  c += vec3(0.55, 0.65, 0.65) * pow(max(dot(n, h), 0.0), 48.0) * 0.45 * lit * day;
  float rim = pow(1.0 - max(dot(n, v), 0.0), 4.0);
  c += mix(sky(vec3(0.0, 0.0, 1.0)), waterBody(reflect(-v, n)), under) * rim * 0.35;
  c += uGlow * vec3(1.0, 0.45, 0.12) * (0.06 + 0.5 * pow(1.0 - max(dot(n, v), 0.0), 2.0));
  gl_FragColor = vec4(finish(throughWater(c, vPlace)), 1.0);
}`,
};

// The robot seen from the sun: depth in three bytes.
const SHADOW = {
  vertex: BENT + "void main() { gl_Position = projectionMatrix * viewMatrix * vec4(placed(), 1.0); }",
  fragment: /* glsl */ `
precision highp float;
void main() {
  vec3 c = fract(gl_FragCoord.z * vec3(1.0, 255.0, 65025.0));
  gl_FragColor = vec4(c - c.yzz * vec3(1.0 / 255.0, 1.0 / 255.0, 0.0), 1.0);
}`,
};

const BED = {
  vertex: /* glsl */ `
void main() {
  vPlace = position;
  vNormal = normal;
  gl_Position = projectionMatrix * viewMatrix * vec4(position, 1.0);
}`,
  fragment: /* glsl */ `
void main() {
  float below = uSurface - vPlace.z, under = smoothstep(-0.05, 0.05, below);
  vec2 p = vPlace.xy / uSize;
  float pixel = length(fwidth(p));
  // Ripples of sand, lost where they are finer than a pixel.
  float warp = 2.2 * fbm(p * 0.8);
  float ripple = sin(p.x * 9.0 + p.y * 3.0 + warp * 4.0);
  float fine = 1.0 - smoothstep(0.08, 0.35, pixel);
  vec2 tilt = fine * 0.16 * cos(p.x * 9.0 + p.y * 3.0 + warp * 4.0) * vec2(0.95, 0.31);
  vec3 n = normalize(vNormal - vec3(tilt, 0.0));
  float grain = fine * (noise(p * 60.0) - 0.5) + (noise(p * 7.0) - 0.5) * 0.8 + (fbm(p * 0.4) - 0.5);
  vec3 albedo = ${glsl(PALETTE.sand)} * (1.0 + 0.22 * grain + 0.10 * fine * ripple);
  albedo = mix(albedo, vec3(0.17, 0.22, 0.10), (1.0 - under) * smoothstep(0.2, 1.5, -below) * 0.8);
  float lit = mix(1.0, sunlit(vPlace, vec3(0.0, 0.0, 1.0), 9.0), under);
  float sun = max(dot(n, uSun), 0.0) * lit;
  vec3 light = mix(vec3(0.50, 0.58, 0.62), vec3(0.26, 0.36, 0.37), under) * (0.6 + 0.4 * n.z);
  light += mix(vec3(1.4, 1.3, 1.1), vec3(0.85, 0.98, 0.92), under) * sun
    * mix(1.0, 0.62 + 1.5 * causticAt(vPlace), under);
  vec3 c = throughWater(albedo * light * daylight(below), vPlace);
  if (uEye.z < uSurface) {
    float far = length(vPlace - uEye);
    c += shafts((vPlace - uEye) / far, far) * (1.0 - exp(-ABSORB.g * far));
  }
  gl_FragColor = vec4(finish(c), 1.0);
}`,
};

const SURFACE = {
  vertex: /* glsl */ `
uniform vec2 uCenter;
attribute float spacing;  // of the mesh here, m
void main() {
  vec2 p = position.xy + uCenter;
  vPlace = vec3(p, uSurface + sea(p, spacing).z);
  gl_Position = projectionMatrix * viewMatrix * vec4(vPlace, 1.0);
}`,
  fragment: /* glsl */ `
// Slope of wind ripples: decoration, in normals only. Short ones fade where a pixel is larger.
vec2 rippleSlope(vec2 p, float pixel) {
  vec2 s = vec2(0.0);
  float angle = 0.4, length_ = 0.085;
  p += 0.05 * vec2(sin(p.y * 3.1 + 0.3 * uTime), sin(p.x * 2.7 - 0.2 * uTime));
  for (int i = 0; i < 11; i++) {
    float k = 6.2832 / length_;
    vec2 d = vec2(cos(angle), sin(angle));
    float seen = 1.0 - smoothstep(0.12, 0.5, pixel / length_);
    s += seen * d * 0.036 * cos(k * dot(d, p) - sqrt(9.81 * k) * uTime * 0.6 + 5.0 * angle);
    angle += 2.399;
    length_ *= 1.33;
  }
  return s;
}

void main() {
  vec3 ray = vPlace - uEye;
  float far = length(ray), pixel = length(fwidth(vPlace.xy));
  vec3 d = ray / far;
  vec2 slope = sea(vPlace.xy, pixel).xy + rippleSlope(vPlace.xy, pixel) * mix(1.0, 0.6, smoothstep(5.0, 60.0, far));
  vec3 n = normalize(vec3(-slope, 1.0));
  if (uEye.z > vPlace.z) {
    float facing = max(dot(n, -d), 0.02);
    float mirror = 0.02 + 0.98 * pow(1.0 - facing, 5.0);
    vec3 r = reflect(d, n);
    r.z = abs(r.z) + 0.01;
    vec3 sunward = normalize(vec3(uSun.xy * 1.33, uSun.z));
    vec3 glint = vec3(1.0, 0.95, 0.85) * 5.0 * pow(max(dot(r, sunward), 0.0), 700.0);
    // A little of the water's own light, so that its surface is seen from straight above too.
    float own = 0.07 + 0.5 * max(0.0, dot(slope, uSun.xy));
    vec3 c = sky(r) * mirror + vec3(0.25, 0.55, 0.60) * own + glint;
    float alpha = clamp(mirror + own + glint.g, 0.0, 1.0);
    vec3 haze = sky(vec3(d.xy, 0.03));
    c = mix(haze, c / max(alpha, 1e-3), exp(-0.004 * far));
    gl_FragColor = vec4(finish(c), mix(alpha, 1.0, smoothstep(150.0, 500.0, far)));
    return;
  }
  // From below: the sky inside Snell's window, beyond it a mirror of the deep.
  vec3 out_ = refract(d, -n, 1.333);
  vec3 mirrored = waterBody(reflect(d, -n)) * 0.9, c = mirrored;
  if (dot(out_, out_) > 0.0) {
    float cosine = max(dot(out_, n), 0.0);
    float mirror = 0.02 + 0.98 * pow(1.0 - cosine, 5.0);
    vec3 above = sky(normalize(vec3(out_.xy, max(out_.z, 0.02))));
    c = mix(above * vec3(0.72, 0.95, 0.98), mirrored, mirror);
  }
  vec3 left = exp(-ABSORB * far);
  c = c * left + (waterBody(d) + shafts(d, far)) * (1.0 - left.g);
  gl_FragColor = vec4(finish(c), mix(0.94, 1.0, 1.0 - left.g));
}`,
};

// Lines to measure by, level with the robot's lowest place, and its shadow.
const GRID = {
  vertex: /* glsl */ `
uniform float uHeight, uReach;
void main() {
  vPlace = vec3(uTarget.xy + position.xy * uReach, uHeight);
  gl_Position = projectionMatrix * viewMatrix * vec4(vPlace, 1.0);
}`,
  fragment: /* glsl */ `
uniform float uReach, uStep, uShade;
float lines(vec2 p) {
  vec2 w = fwidth(p), d = abs(fract(p - 0.5) - 0.5) / w;
  vec2 line = (1.0 - smoothstep(0.3, 1.1, d)) * (1.0 - smoothstep(0.15, 0.5, w));
  return max(line.x, line.y);
}
void main() {
  float far = length(vPlace.xy - uTarget.xy) / uReach;
  float seen = 1.0 - smoothstep(0.15, 1.0, far);
  float line = max(0.14 * lines(vPlace.xy / uStep), 0.30 * lines(vPlace.xy / uStep / 5.0));
  float shade = uShade * 0.5 * (1.0 - sunlit(vPlace, vec3(0.0, 0.0, 1.0), 9.0));
  vec3 ray = vPlace - uEye;
  float clear = exp(-0.10 * uHaze * length(ray));
  vec3 c = mix(vec3(0.002, 0.02, 0.04), vec3(0.55, 0.85, 0.90), line / max(line + shade, 1e-3));
  gl_FragColor = vec4(finish(c), (line + shade * (1.0 - line)) * seen * clear);
}`,
};

// Dust that drifts with the water.
const DUST = {
  vertex: /* glsl */ `
uniform vec3 uDrift;
uniform float uBox, uPixels;
attribute float weight;
varying float vAlpha;
void main() {
  vec3 p = position * uBox + uDrift;
  p += 0.02 * uSize * vec3(sin(uTime * 0.5 + weight * 40.0), cos(uTime * 0.4 + weight * 70.0), sin(uTime * 0.3 + weight * 90.0));
  p = mod(p - uTarget, uBox) - 0.5 * uBox;
  float edge = 1.0 - smoothstep(0.35, 0.5, max(max(abs(p.x), abs(p.y)), abs(p.z)) / uBox);
  p += uTarget;
  float below = p.z - uSurface;
  for (int i = 0; i < MAX_WAVES; i++) {
    vec4 w = uWaves[i];
    float k = uFade[i], a = w.z * exp(k * min(below, 0.0)), angle = dot(w.xy, p.xy) + w.w;
    p.xy -= a * w.xy / max(k, 1e-6) * sin(angle);
    p.z += a * cos(angle);
  }
  vec4 view = viewMatrix * vec4(p, 1.0);
  gl_Position = projectionMatrix * view;
  float size = (0.5 + weight) * 0.0075 * uSize * uPixels / max(-view.z, 1e-3);
  gl_PointSize = clamp(size, 1.2, 9.0);
  vAlpha = edge * min(size / 1.2, 1.0) * min(1.0, 9.0 / size) * step(p.z, uSurface - 0.01)
    * exp(-0.15 * -view.z) * smoothstep(0.15, 0.5, -view.z / uSize);
}`,
  fragment: /* glsl */ `
varying float vAlpha;
void main() {
  float r = length(gl_PointCoord - 0.5);
  gl_FragColor = vec4(${PALETTE.dust.map((x) => x.toFixed(3)).join()}, 0.42 * vAlpha * (1.0 - smoothstep(0.1, 0.5, r)));
}`,
};

// Arrows, and the bars of a trail, of which `uThick` is the width at a metre from the eye.
const ARROW = {
  vertex: /* glsl */ `
uniform float uThick;
void main() {
  float wide = uThick > 0.0 ? uThick * length((instanceMatrix * vec4(0.0, 0.0, 0.0, 1.0)).xyz - uEye) : 1.0;
  vec4 place = instanceMatrix * vec4(position * vec3(wide, 1.0, wide), 1.0);
  vPlace = place.xyz;
  vNormal = mat3(instanceMatrix) * normal;
  gl_Position = projectionMatrix * viewMatrix * place;
}`,
  fragment: /* glsl */ `
uniform vec3 uColor;
uniform float uAlpha;
void main() {
  vec3 n = normalize(vNormal);
  float light = 0.75 + 0.25 * n.z + 0.15 * max(dot(n, normalize(uEye - vPlace)), 0.0);
  vec3 c = linear(uColor) * light * 1.25;
  gl_FragColor = vec4(finish(mix(throughWater(c, vPlace), c, 0.75)), uAlpha);
}`,
};
