// What the page uses of three.js; see README.md for how three.min.js is made from this.
export {
  AdditiveBlending, BackSide, BufferAttribute, BufferGeometry, ConeGeometry, CylinderGeometry,
  DoubleSide, DynamicDrawUsage, EdgesGeometry, Group, InstancedMesh, LineSegments, Matrix4, Mesh,
  NearestFilter, OrthographicCamera, PerspectiveCamera, PlaneGeometry, Points, Quaternion, Scene,
  ShaderMaterial, Vector2, Vector3, Vector4, WebGLRenderTarget, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
