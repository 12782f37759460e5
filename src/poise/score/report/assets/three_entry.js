// The part of three.js that the replay uses. Rebuild three.min.js from this folder with:
// npm install --no-save three@0.187.0 esbuild@0.28.2 && npx esbuild three_entry.js --bundle --minify --format=iife --global-name=THREE --legal-comments=inline --outfile=three.min.js && rm -r node_modules
export {
  BoxGeometry,
  BufferGeometry,
  CapsuleGeometry,
  CircleGeometry,
  Color,
  ConeGeometry,
  CylinderGeometry,
  DirectionalLight,
  Fog,
  Group,
  HemisphereLight,
  Mesh,
  MeshBasicMaterial,
  MeshStandardMaterial,
  PerspectiveCamera,
  PlaneGeometry,
  Quaternion,
  Scene,
  ShaderMaterial,
  ShadowMaterial,
  SphereGeometry,
  Vector3,
  WebGLRenderer,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
